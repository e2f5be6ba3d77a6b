"""The name by which MAVProxy finds its module: `module load locagen` (docs/mavlink.md)."""

from locagen_edge.mavproxy_locagen import init

__all__ = ["init"]
