from .hands import cluster_hands as cluster_hands
from .place import parse_address as parse_address
