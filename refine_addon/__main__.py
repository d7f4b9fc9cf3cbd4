"""``python -m refine_addon``, and the script ``refine`` that ``pip`` installs."""

import sys


def main() -> int:
    """Run the command on this process's arguments; exit code as of `refine_addon.command.main`."""
    try:
        # Only here: Ctrl-C may come while these load.
        from . import command

        # Afterwards a signal would only break into Python's own tidying up.
        code = command.main(sys.argv[1:], last=True)
    except KeyboardInterrupt:  # when the command does not listen yet, or no more
        print("refine: error: cancelled; nothing was left half-written", file=sys.stderr)
        return 130
    return code


if __name__ == "__main__":
    sys.exit(main())
