from .ablation import run_ablation as run_ablation
from .loop import train as train
from .run_folder import Run as Run
from .settings import Settings as Settings
