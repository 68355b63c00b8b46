from .report import build_page as build_page
from .views import open_source as open_source
