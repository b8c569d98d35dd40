"""The program ``pbrl-ppl``, also as ``python -m pbrl_ppl``."""

import signal
import sys


def main() -> int:
    """Run the command line and return its exit code; an interrupt during imports ends at once."""
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from pbrl_ppl.cli import main as command_line

    if handled:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return command_line()


if __name__ == "__main__":
    sys.exit(main())
