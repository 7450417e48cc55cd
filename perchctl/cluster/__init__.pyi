from .hands import cluster_hands as cluster_hands
from .hands import parse_address as parse_address
