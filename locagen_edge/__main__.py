"""python -m locagen_edge"""

from locagen_edge.cli import main

main()
