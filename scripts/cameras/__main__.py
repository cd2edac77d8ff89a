"""Runs the campaign over cameras and attitudes: python scripts/cameras [options]."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # Python puts this folder there, not the one that holds the packages
    from cameras.campaign import main
    from runtime import terminal

    terminal.run(main)
