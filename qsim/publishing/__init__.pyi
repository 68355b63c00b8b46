from .publication import Publication as Publication
from .publication import publish as publish
from .published_set import PublishedSet as PublishedSet
