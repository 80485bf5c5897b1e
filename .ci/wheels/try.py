"""Installs the wheel of saccade for this machine into an empty environment, and acts with it.

    python .ci/wheels/try.py dist [--numpy 1.26.4]

For any system and any CPython that saccade supports. pip takes NumPy from its index. `check.py` is what runs
in the environment. `test.py` does more, on Linux: several CPythons, NumPys and emulated CPUs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

CHECK = Path(__file__).resolve().with_name("check.py")


def main() -> int:
    """Makes the environment, installs, checks; the exit status is that of the check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheels", type=Path, help="the folder of the wheels")
    parser.add_argument("--numpy", help="a version of NumPy (default: the newest)")
    args = parser.parse_args()
    # Neither the packages of this process nor the checkout may be visible.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    with tempfile.TemporaryDirectory() as folder:
        venv.create(Path(folder) / "env", with_pip=True)
        python = Path(folder) / "env" / ("Scripts" if os.name == "nt" else "bin") / "python"
        install = [str(python), "-m", "pip", "--disable-pip-version-check", "--no-input", "install"]
        numpy = f"numpy=={args.numpy}" if args.numpy else "numpy"
        for words in (
            ["--only-binary", ":all:", numpy],
            # pip takes the wheel of this machine out of the folder, or says that there is none.
            ["--no-deps", "--no-index", "--find-links", str(args.wheels.resolve()), "saccade-vla"],
        ):
            subprocess.run([*install, "--quiet", *words], cwd=folder, env=environment, check=True)
        check = [str(python), str(CHECK), "actions.npz"]
        done = subprocess.run(check, cwd=folder, env=environment, check=False)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
