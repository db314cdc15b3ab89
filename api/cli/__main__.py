"""``python -m api.cli`` is ``veilface``."""

from api.cli import main

if __name__ == "__main__":
    main()
