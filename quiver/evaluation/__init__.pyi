from .comparison import Comparison as Comparison
from .comparison import evaluate as evaluate
from .comparison_rows import ComparisonRow as ComparisonRow
from .metrics import Score as Score
from .metrics import score as score
