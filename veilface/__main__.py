"""The command ``veilface``, which is ``python -P -m veilface`` too."""

import os
import signal


def main() -> None:
    """Run the command line on ``sys.argv``."""
    # As -P does, for every Python that a library starts: those of joblib would import a `random.py`
    # of the working directory.
    os.environ["PYTHONSAFEPATH"] = "1"
    # Ctrl-C just ends the process until a command runs: there is nothing to clean up, and libraries
    # that are being imported turn a KeyboardInterrupt into errors of other kinds.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from api.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
