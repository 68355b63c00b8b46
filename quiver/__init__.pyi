from .data.windows import windows as windows
from .evaluation.comparison import score_video as score  # noqa: F401  (public name)
from .model.published_weights import from_published as from_published
from .model.quiver import QUIVER as QUIVER
from .restoration.api import restore as restore
