from .methods import METHODS as METHODS
from .methods import Method as Method
