"""Shows clips, streams and stored results as pages and previews."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.report.report import build_page
    from qsim.report.views import open_source

__all__ = ["build_page", "open_source"]

__getattr__ = lazy_names(__name__, {"build_page": "report", "open_source": "views"})
