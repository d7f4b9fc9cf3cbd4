"""``python -m refine_addon``, and the script ``refine`` that ``pip`` installs."""

import sys


def main() -> int:
    """Run the command on this process's arguments; exit code as of `refine_addon.command.main`."""
    try:
        # Inside the try: Ctrl-C may come while it loads.
        from . import command

        return command.main(sys.argv[1:], last=True)
    except KeyboardInterrupt:  # before the command handles signals, or after
        print("refine: error: cancelled; nothing was left half-written", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
