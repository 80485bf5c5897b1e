"""Virtual environments of the tasks in noxfile.py: what is installed in them, and when it is out of date."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path

import nox

ROOT = Path(__file__).resolve().parents[1]
MAKE = ROOT / ".venv"  # where the Makefile installs nox
ENVIRONMENTS = ROOT / ".nox"
PROGRAMS = "Scripts" if os.name == "nt" else "bin"
PYTHON = "python.exe" if os.name == "nt" else "python"


def digest(files: Iterable[Path]) -> str:
    """SHA-256 of the names and contents of files."""
    found = hashlib.sha256()
    for file in sorted(files):
        found.update(f"{file.relative_to(ROOT)} {file.stat().st_size}\n".encode())
        found.update(file.read_bytes())
    return found.hexdigest()


def rust_sources() -> list[Path]:
    """What the extension is built from."""
    files = [path for path in (ROOT / "crates").rglob("*") if path.is_file()]
    return [*files, *(ROOT / name for name in ("Cargo.toml", "Cargo.lock", "pyproject.toml"))]


class Environment:
    """A virtual environment, with a note of what its steps were made from.

    Args:
        session: The task that needs it.
        folder: Where it is, or is to be created.
        python: The interpreter that creates it.
    """

    def __init__(self, session: nox.Session, folder: Path, python: str = sys.executable) -> None:
        self.session = session
        self.folder = folder
        self.python = folder / PROGRAMS / PYTHON
        self.note = folder / "saccade-steps.json"
        # An environment that was copied or moved points to its old place.
        command = [str(self.python), "-c", "import sys; print(sys.prefix)"]
        said = session.run(*command, silent=True, external=True, log=False) if self.python.exists() else ""
        if str(said).strip() != str(folder):
            session.run(python, "-m", "venv", "--clear", str(folder), external=True, log=False)
        self.steps: dict[str, str] = json.loads(self.note.read_text()) if self.note.exists() else {}

    def program(self, name: str) -> str:
        """The path of a program that is installed in it."""
        return str(self.folder / PROGRAMS / name)

    def run(self, *command: str | Path, **variables: str) -> None:
        """Runs its Python with these arguments and environment variables."""
        self.session.run(str(self.python), *map(str, command), env=variables, external=True)

    def is_done(self, step: str, made_from: str) -> bool:
        """Whether a step was taken with these inputs."""
        return self.steps.get(step) == made_from

    def done(self, step: str, made_from: str) -> None:
        """Notes that a step was taken."""
        self.steps[step] = made_from
        self.note.write_text(json.dumps(self.steps, indent=1))

    def pip(self, *arguments: str | Path) -> None:
        """Installs these, and nothing that they require."""
        options = "--disable-pip-version-check --no-input install --quiet --no-deps --no-build-isolation"
        # Without build isolation maturin's hook calls the program `maturin`: the one of this environment.
        path = os.pathsep.join((str(self.folder / PROGRAMS), os.environ["PATH"]))
        self.run("-m", "pip", *options.split(), *arguments, MATURIN_PEP517_ARGS="--locked", PATH=path)

    def install(self, name: str, folder: str = "requirements") -> Environment:
        """Installs the packages of FOLDER/NAME.txt, which is complete."""
        file = ROOT / folder / f"{name}.txt"
        made_from = digest([file])
        if not self.is_done(name, made_from):
            print(f"setup: {folder}/{file.name} (takes minutes the first time)", flush=True)
            self.pip("--requirement", file)
            self.done(name, made_from)
        return self

    def lies_on(self, below: Environment) -> Environment:
        """Adds the packages of another environment, after its own."""
        where = "import sysconfig; print(sysconfig.get_path('purelib'))"
        found = (
            self.session.run(str(one.python), "-c", where, silent=True, external=True, log=False)
            for one in (below, self)
        )
        theirs, own = (Path(str(path).strip()) for path in found)
        (own / "below.pth").write_text(f"import site; site.addsitedir({str(theirs)!r})\n")
        return self

    def install_saccade(self, *, editable: bool = True) -> Environment:
        """Installs saccade, and builds its extension if what that is made from has changed."""
        package = ROOT / "python" / "saccade"
        files = rust_sources()
        if not editable:
            files += [path for path in package.rglob("*") if path.suffix in (".py", ".pyi", ".json")]

        def made_from() -> str:
            # Editable installations share the extension: another one may have built it from other sources.
            built = [path.stat().st_mtime_ns for path in package.glob("_saccade*.so")] if editable else []
            return f"{digest(files)} {built}"

        if not self.is_done("saccade", made_from()):
            print("setup: saccade (builds the Rust code; takes minutes the first time)", flush=True)
            self.pip("--editable" if editable else "--force-reinstall", ROOT)
            self.done("saccade", made_from())
        return self

    def install_lab(self) -> Environment:
        """Installs saccade's laboratory as editable."""
        made_from = digest([ROOT / "lab" / "pyproject.toml"])
        if not self.is_done("lab", made_from):
            self.pip("--editable", ROOT / "lab")
            self.done("lab", made_from)
        return self


def needs(session: nox.Session, *names: str, required: bool = True) -> None:
    """Says which packages have what this machine lacks, and stops if it is required."""
    command = (sys.executable, str(ROOT / ".ci" / "needs.py"), *names)
    session.run(*command, external=True, log=False, success_codes=[0] if required else [0, 1])


def working(session: nox.Session, requirements: str = "dev") -> Environment:
    """`.venv`, with everything that tests and linters need, or with the packages of another file."""
    needs(session, "python", "rust", "opengl")
    return Environment(session, MAKE).install(requirements).install_saccade().install_lab()
