"""Makes data sets from recipes: jobs, workers, resuming, provenance, and a forecast of the cost."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.dataset.cost_forecast import forecast
    from qsim.dataset.dataset import Dataset
    from qsim.dataset.generation import generate
    from qsim.dataset.recipe import Recipe

__all__ = ["Dataset", "Recipe", "forecast", "generate"]

__getattr__ = lazy_names(
    __name__,
    {
        "Dataset": "dataset",
        "Recipe": "recipe",
        "forecast": "cost_forecast",
        "generate": "generation",
    },
)
