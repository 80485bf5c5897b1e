"""Installs the wheel of saccade for this machine into an empty environment, and acts with it.

    python .ci/wheels/try.py dist [--numpy 1.26.4] [--all]

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
PACKAGES = ("saccade-vla", "saccade-vla-lab", "lerobot-policy-saccade")
#: The lab can be imported, the plugin is found, and all are of one version.
TOGETHER = f"""
import importlib.metadata, importlib.util, pathlib, sys
import saccade_lab.extras, saccade_lab.cli.rollout
plugin = importlib.util.find_spec("lerobot_policy_saccade")
for origin in (saccade_lab.extras.__file__, plugin.origin):
    assert pathlib.Path(sys.prefix) in pathlib.Path(origin).parents, origin
versions = set(map(importlib.metadata.version, {PACKAGES}))
assert len(versions) == 1, versions
"""


def main() -> int:
    """Makes the environment, installs, checks; the exit status is that of the check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheels", type=Path, help="the folder of the wheels")
    parser.add_argument("--numpy", help="a version of NumPy (default: the newest)")
    parser.add_argument(
        "--all", action="store_true", help="also the lab and the plugin, without what they require"
    )
    args = parser.parse_args()
    packages = PACKAGES if args.all else PACKAGES[:1]
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
            ["--no-deps", "--no-index", "--find-links", str(args.wheels.resolve()), *packages],
        ):
            subprocess.run([*install, "--quiet", *words], cwd=folder, env=environment, check=True)
        if args.all:
            subprocess.run([str(python), "-c", TOGETHER], cwd=folder, env=environment, check=True)
        check = [str(python), str(CHECK), "actions.npz"]
        done = subprocess.run(check, cwd=folder, env=environment, check=False)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
