from .config import Config as Config
from .published_weights import from_published as from_published
from .quiver import QUIVER as QUIVER
from .unet import UNet as UNet
from .unet import UNetConfig as UNetConfig
