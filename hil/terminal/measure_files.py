"""The files of ``hil measure``."""

from collections.abc import Mapping
from pathlib import Path

from drivers.errors import BadInput
from hil.measuring.figures import Measured

PICTURES = (".png", ".svg", ".pdf")


def require_places(files: Mapping[str, Path | None]) -> None:
    """Raises BadInput for an option whose file could not be written, before anything is measured."""
    for option, path in files.items():
        if path is None:
            continue
        if path.is_dir() or not path.parent.is_dir():
            raise BadInput(option, "", str(path), "a file in a folder that is there")
        if option == "--picture" and path.suffix not in PICTURES:
            raise BadInput(option, "", str(path), f"a file that ends in {', '.join(PICTURES)}")


def write_files(
    measured: Measured, out: Path | None, faults_out: Path | None, picture: Path | None
) -> list[str]:
    """Write what is asked for; what was written, in words. Raises BadInput for a file that cannot be."""
    from hil.configuration.network_file import network_text
    from hil.measuring.network import fault_plan_text

    texts: dict[Path, str] = {}
    if out is not None and measured.network is not None:
        texts[out] = (
            f"# Measured on {measured.request.bus} by hil measure.\n\n{network_text(measured.network)}"
        )
    if faults_out is not None:
        texts[faults_out] = fault_plan_text(measured)
    written = []
    try:
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
            written.append(f"written: {path}")
        if picture is not None:
            from hil.measuring.picture import draw_stages

            draw_stages(picture, measured)
            written.append(f"written: {picture}")
    except OSError as error:
        raise BadInput(str(error.filename), "", error.strerror, "a place to write to") from error
    return written
