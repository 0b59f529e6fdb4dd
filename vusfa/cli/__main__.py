"""``python -m vusfa.cli``: same as the script ``vusfa``."""

from vusfa.cli import main

if __name__ == "__main__":
    main()
