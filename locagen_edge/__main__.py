"""python -m locagen_edge, and the command `locagen-edge`: a signal to stop is obeyed from the first moment.

Half a second goes by until all is imported, and until the event loop has its own way to stop (`stopping.py`);
a service that is stopped meanwhile has done nothing yet, and ends as cleanly as later.
"""

from locagen_edge import stopping


def main() -> None:
    """Entry point of `locagen-edge`."""
    with stopping.obeyed():
        from locagen_edge import cli

        cli.main()


if __name__ == "__main__":
    main()
