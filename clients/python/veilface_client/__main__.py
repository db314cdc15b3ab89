"""``python -m veilface_client`` and the command ``veilface-client``."""

import sys

from veilface_client.command import main


def run() -> None:
    """Run the command, and exit with its status."""
    sys.exit(main())


if __name__ == "__main__":
    run()
