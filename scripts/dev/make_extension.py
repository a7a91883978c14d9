"""`make extension`: one zip per platform, with the wheels for it, checked: dist/lipac-0.1.0-linux_x64.zip and so on."""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from ...version import __version__
from .lock import pins

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = "blender_manifest.toml"
LIBRARIES = ("numba", "llvmlite", "embreex", "opengl-decimate")
PYTHONS = ("311", "313")  # of Blender 5.0, and of 5.1 and later
# Blender's name of a platform: pip's names, newest first
PLATFORMS = {
    "linux-x64": ("manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"),
    "windows-x64": ("win_amd64",),
    "macos-arm64": ("macosx_13_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"),
}
# Of docs/: the manual of the panel's controls, and what it refers to
PAGES = (
    "user-guide",
    "write-back",
    "live",
    "viewport",
    "error",
    "supported",
    "for-my-scene",
    "troubleshooting",
    "install",
    "glossary",
)
STYLE = (
    "body{max-width:60em;margin:2em auto;font:16px/1.5 sans-serif}img{max-width:100%}td,th{padding:.2em "
    ".6em;text-align:left;border:1px solid #ccc}"
)
PACKAGES = ("core", "page", "lipac_addon", "scripts")
SUFFIXES = {".py", ".npz", ".c", ".sh", ".js", ".html", ".css"}


def main(argv: Sequence[str] | None = None) -> int:
    """Build and check the zips; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist")
    parser.add_argument(
        "--platform", choices=PLATFORMS, action="append", help="only this one; may be repeated (default: all)"
    )
    parser.add_argument(
        "--python", choices=PYTHONS, action="append", help="wheels for this Python only; may be repeated (default: all)"
    )
    parser.add_argument("--wheels", type=Path, help="folder to keep downloaded wheels in (default: OUTPUT/wheels)")
    args = parser.parse_args(argv)
    args.output.mkdir(parents=True, exist_ok=True)
    pythons = tuple(args.python or PYTHONS)
    for platform in args.platform or PLATFORMS:
        wheels = download(platform, pythons, args.wheels or args.output / "wheels")
        path = build(platform, wheels, args.output)
        check(path, platform, pythons)
        print(f"{path}: {path.stat().st_size / 1e6:.0f} MB, {len(wheels)} wheels")
    return 0


def download(platform: str, pythons: Iterable[str], folder: Path) -> list[Path]:
    """Wheels of LIBRARIES for a platform at the versions of the lock, fetched by pip where they are not there. Sorted
    paths."""
    found: list[Path] = []
    for python in pythons:
        place = folder / platform / f"cp{python}"
        locked = pins({"python_full_version": f"{python[0]}.{python[1:]}.0"})
        wanted = {name: locked[name] for name in LIBRARIES}
        if not all(any(place.glob(f"{name.replace('-', '_')}-{version}-*.whl")) for name, version in wanted.items()):
            names = [f"--platform={name}" for name in PLATFORMS[platform]]
            only = [
                "--no-deps",
                "--only-binary=:all:",
                f"--python-version={python}",
                "--implementation=cp",
                f"--abi=cp{python}",
            ]
            command = [
                sys.executable,
                "-m",
                "pip",
                "download",
                "-q",
                "--disable-pip-version-check",
                *only,
                *names,
                "-d",
                str(place),
            ]
            subprocess.run([*command, *(f"{name}=={version}" for name, version in wanted.items())], check=True)
        found += [next(place.glob(f"{name.replace('-', '_')}-{version}-*.whl")) for name, version in wanted.items()]
    return sorted(found)


def sources() -> list[Path]:
    """Files of the extension, relative to the root."""
    inside = [
        path
        for name in PACKAGES
        for path in (ROOT / name).rglob("*")
        if path.suffix in SUFFIXES and "__pycache__" not in path.parts
    ]
    outside = [ROOT / name for name in ("__init__.py", "version.py", "py.typed", "LICENSE", "README.md")]
    return sorted(path.relative_to(ROOT) for path in (*inside, *outside))


def build(platform: str, wheels: Sequence[Path], output: Path) -> Path:
    """Put sources, wheels and their manifest together and have Blender's own tool zip and validate them. Returns the
    zip."""
    with tempfile.TemporaryDirectory() as folder:
        stage = Path(folder)
        for path in sources():
            (stage / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, stage / path)
        write_docs(stage / "docs")
        (stage / "wheels").mkdir()
        for wheel in wheels:
            shutil.copyfile(wheel, stage / "wheels" / wheel.name)
        (stage / MANIFEST).write_text(manifest(platform, [wheel.name for wheel in wheels]))
        path = output / f"lipac-{__version__}-{platform.replace('-', '_')}.zip"
        path.unlink(missing_ok=True)
        blender("build", "--source-dir", str(stage), "--output-filepath", str(path.resolve()))
    blender("validate", str(path.resolve()))
    return path


def write_docs(folder: Path) -> None:
    """The pages for the panel's controls as HTML, with the pictures that they show."""
    from markdown import markdown

    (folder / "pictures").mkdir(parents=True)
    for name in PAGES:
        body = markdown((ROOT / "docs" / f"{name}.md").read_text(), extensions=["tables", "toc", "fenced_code"])
        body = re.sub(r'<a href="([\w./-]+)\.(?:md|json)([^"]*)">(.*?)</a>', _inside, body, flags=re.DOTALL)
        (folder / f"{name}.html").write_text(
            f"<!doctype html><meta charset=utf-8><title>LiPaC</title><style>{STYLE}</style>\n{body}\n"
        )
        for picture in re.findall(r'src="pictures/([^"]+)"', body):
            shutil.copyfile(ROOT / "docs" / "pictures" / picture, folder / "pictures" / picture)


def _inside(link: re.Match[str]) -> str:
    """A link of a page for browsers, or its text alone where what it leads to is not in the zip."""
    name, anchor, text = link.groups()
    return f'<a href="{name}.html{anchor}">{text}</a>' if name in PAGES else text


def manifest(platform: str, wheels: Iterable[str]) -> str:
    """The manifest for a platform: the one of the sources, with the platform and its wheels."""
    head, tables = (ROOT / MANIFEST).read_text().split("\n[permissions]", 1)
    listed = "".join(f'  "./wheels/{name}",\n' for name in wheels)
    return f'{head}platforms = ["{platform}"]\nwheels = [\n{listed}]\n\n[permissions]{tables}'


def blender(*arguments: str) -> None:
    """Run Blender's command line for extensions. Raises CalledProcessError where it finds an error."""
    code = (
        "import sys; from bl_pkg.bl_extension_cli import cli_extension_handler; "
        "sys.exit(cli_extension_handler(sys.argv[1:]))"
    )
    subprocess.run([sys.executable, "-c", "import bpy; " + code, *arguments], check=True, stdout=subprocess.DEVNULL)


def check(path: Path, platform: str, pythons: Iterable[str]) -> None:
    """Raise SystemExit where a zip lacks a library for a Python of the platform, or holds what does not belong into
    it."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        stated = tomllib.loads(archive.read(MANIFEST).decode())
    wheels = {name.removeprefix("wheels/") for name in names if name.endswith(".whl")}
    listed = {name.removeprefix("./wheels/") for name in stated["wheels"]}
    problems = [f"{name} is not in the manifest, or not in the zip" for name in wheels ^ listed]
    for python in pythons:
        for library in LIBRARIES:
            begin = f"{library.replace('-', '_')}-"
            fitting = [
                w
                for w in wheels
                if w.startswith(begin) and f"-cp{python}-" in w and any(p in w for p in PLATFORMS[platform])
            ]
            if len(fitting) != 1:
                problems.append(f"{len(fitting)} wheels of {library} for Python {python} on {platform}")
    problems += [f"{path} is missing" for path in map(str, sources()) if path not in names]
    problems += [f"docs/{name}.html is missing" for name in PAGES if f"docs/{name}.html" not in names]
    problems += [
        f"{name} does not belong here"
        for name in names
        if "__pycache__" in name or name.startswith(("tests/", "docs/results", "."))
    ]
    if stated["platforms"] != [platform]:
        problems.append(f"platforms are {stated['platforms']}")
    if problems:
        raise SystemExit(f"{path}: " + "; ".join(problems))


if __name__ == "__main__":
    sys.exit(main())
