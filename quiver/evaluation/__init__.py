"""Scores methods, measures their costs, and writes tables of both."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.evaluation.comparison import Comparison, evaluate
    from quiver.evaluation.comparison_rows import ComparisonRow
    from quiver.evaluation.metrics import Score, score

__all__ = ["Comparison", "ComparisonRow", "Score", "evaluate", "score"]

__getattr__ = lazy_names(
    __name__,
    {
        "Comparison": "comparison",
        "ComparisonRow": "comparison_rows",
        "Score": "metrics",
        "evaluate": "comparison",
        "score": "metrics",
    },
)
