"""``python -m vusfa.scenes compact IN.h5 OUT.h5``: make a small copy of a scene file.

The bundled rooms were made with it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from vusfa.errors import SceneError
from vusfa.scenes.store import compact

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 when the copy was made, 1 when the scene has faults (said on stderr)."""
    parser = argparse.ArgumentParser(prog="python -m vusfa.scenes", description="Work on scene files.")
    commands = parser.add_subparsers(dest="command", required=True)
    small = commands.add_parser(
        "compact", help="small copy: float16 features, JPEG pictures, compressed tables"
    )
    small.add_argument("source", metavar="IN", help="scene file to read")
    small.add_argument("target", metavar="OUT", help="scene file to write")
    options = parser.parse_args(arguments)
    try:
        compact(options.source, options.target)
    except SceneError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
