from .cost_forecast import forecast as forecast
from .dataset import Dataset as Dataset
from .generation import generate as generate
from .recipe import Recipe as Recipe
