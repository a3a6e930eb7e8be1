"""``python -m sonar_graph`` is ``sonar-graph``, where the folder of that command is not on the path."""

from sonar_graph.cli import main

if __name__ == "__main__":
    main()
