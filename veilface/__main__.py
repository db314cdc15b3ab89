"""The command ``veilface``, which is ``python -P -m veilface`` too."""

import os


def main() -> None:
    """Run the command line on ``sys.argv``."""
    # As -P does, for every Python that a library starts: those of joblib would import a `random.py`
    # of the working directory.
    os.environ["PYTHONSAFEPATH"] = "1"
    from api.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
