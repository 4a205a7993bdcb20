"""Builds the wheel from the working tree and installs it away from the repository."""

import os
import shutil
import site
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 1800


def run(*command: object, **options: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        list(map(str, command)),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        **options,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


def build_wheel(folder: Path) -> Path:
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=ROOT)
    (wheel,) = folder.glob("*.whl")
    return wheel


def environment_of(folder: Path) -> dict[str, str]:
    """A user's environment: no path into the repository, a cache of its own."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return kept | {"XDG_CACHE_HOME": str(folder / "cache"), "HOME": str(folder / "home")}


def install_beside_our_libraries(wheel: Path, folder: Path) -> Path:
    """The command, installed without dependencies into a new environment that sees ours.

    Our site-packages come by a .pth file, whose own .pth files (the editable relpos) do not count.
    """
    venv.EnvBuilder(with_pip=False, symlinks=True).create(folder)
    python = folder / "bin" / "python"
    packages = Path(
        run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").stdout.strip()
    )
    ours = [path for path in site.getsitepackages() if Path(path).is_dir()]
    (packages / "ours.pth").write_text("\n".join(ours) + "\n")
    run(
        sys.executable, "-m", "pip", "--python", python, "install",
        "--no-deps", "--no-index", "--force-reinstall", wheel,
    )  # fmt: skip
    return folder / "bin" / "relpos"


def share_compiled_firmware(environment: dict[str, str]) -> None:
    """Spare the compiler what it has built in the repository; another firmware has another name."""
    built = ROOT / ".build" / "native"
    if built.is_dir():
        shutil.copytree(built, Path(environment["XDG_CACHE_HOME"]) / "relpos" / "native")
