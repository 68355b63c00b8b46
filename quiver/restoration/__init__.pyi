from .api import restore as restore
from .interface import RestoreOptions as RestoreOptions
from .interface import Restorer as Restorer
from .restored_file import restore_to_file as restore_to_file
from .restorers import restorer as restorer
