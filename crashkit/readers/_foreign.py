"""Formats that are known by sight and not read: what they are, and how to get something that is read."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from crashkit.readers._folders import files_in
from crashkit.readers._hdf5_data import SIGNATURE
from crashkit.readers.checks import LIBRARY_ERRORS

# Suffix -> what it is and what to do. Told by suffix alone, since the contents are secret.
_BY_SUFFIX = {
    ".fz": "is packed with FEMZIP, which needs a licence to read; unpack it first (femunzip)",
    ".odb": "is an Abaqus output database; write VTU or Exodus files from it",
    ".op2": "is a Nastran result file; convert it to Exodus or VTU first",
    ".h3d": "is an Altair H3D file; convert it to VTU first, or take the solver's own files",
    ".erfh5": "is an ESI result file; convert it to VTU first",
    ".rst": "is an Ansys result file; write VTU files from it",
    ".bp": "is an ADIOS2 checkpoint (dolfinx); write the displacement with XDMFFile.write_function or VTKFile instead",
    ".k": "is an LS-DYNA deck, not a result; name its d3plot",
    ".key": "is an LS-DYNA deck, not a result; name its d3plot",
    ".rad": "is an OpenRadioss deck, not a result; name its animation files or their folder",
}
# First bytes -> what the file is packed with; reported only where no reader takes the file as it is.
_PACKED = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "ZIP",
    b"7z\xbc\xaf\x27\x1c": "7-Zip",
    b"\xfd7zXZ\x00": "xz",
    b"BZh": "bzip2",
    b"\x28\xb5\x2f\xfd": "Zstandard",
    b"Rar!": "RAR",
}
_TAR, _TAR_AT = b"ustar", 257
_ONE_STATE = "one state without time; name the .pvd or the folder with all states, numbered"
_BY_KIND = {
    "grid": f"is a VTK file with {_ONE_STATE}",
    "pieces": f"is a PVTU file, {_ONE_STATE}",
    "blocks": f"is a VTM file of several blocks, {_ONE_STATE}",
}
# A folder is looked at this far.
_ENTRIES = 200


def name_of(path: Path) -> str | None:
    """What is at `path`, with the cure, where it is a known format that is not read; None where nobody knows."""
    try:
        if path.is_file():
            return _file(path)
        found = (text for file in islice(_entries(path), _ENTRIES) if (text := _file(file)) is not None)
        text = next(found, None)
        return None if text is None else f"holds no format that is read; the first of its files that is known {text}"
    except OSError:
        return None


def _entries(folder: Path) -> Iterator[Path]:
    """The regular files in a folder and in the folders there; an ADIOS2 checkpoint is a folder itself."""
    for entry in (folder, *sorted(p for p in folder.iterdir() if p.is_dir())):
        if entry.suffix == ".bp":
            yield entry
        yield from files_in(entry)


def _file(path: Path) -> str | None:
    from crashkit.readers._d3plot_file import is_femzip
    from crashkit.readers._vtk_lists import kind_of, xml_type

    if path.suffix.lower() in _BY_SUFFIX:
        return _named(path, _BY_SUFFIX[path.suffix.lower()])
    if not path.is_file():
        return None
    if is_femzip(path):
        return _named(path, _BY_SUFFIX[".fz"])
    if (kind := kind_of(path)) in _BY_KIND:
        return _named(path, _BY_KIND[kind])
    if other := xml_type(path):
        return _named(path, f"is a VTK file of type {other}; expected UnstructuredGrid or PolyData with time")
    with path.open("rb") as stream:
        start = stream.read(_TAR_AT + len(_TAR))
    packed = next((name for mark, name in _PACKED.items() if start.startswith(mark)), None)
    if packed is None and start[_TAR_AT:] == _TAR:
        packed = "tar"
    if packed is not None:
        return _named(path, f"is packed with {packed}; unpack it first")
    if start[:3] == b"CDF" and start[3:4] in b"\x01\x02\x05":
        return _named(path, "is a classic NetCDF file and no Exodus file with states; write Exodus, or a crash dataset")
    return _named(path, found) if start.startswith(SIGNATURE) and (found := _hdf5(path)) else None


def _hdf5(path: Path) -> str | None:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            names = set(file)
    except LIBRARY_ERRORS:
        return None
    if "VTKHDF" in names:
        return (
            "is a VTKHDF file of a type that is not read; expected UnstructuredGrid, PolyData or a collection of them"
        )
    if {"Mesh", "Function"} <= names or "Function" in names:
        return "holds the values of an XDMF file; name the .xdmf beside it"
    if {"mesh", "function"} & names or any("cell_dofs" in name for name in names):
        return (
            "is a checkpoint of FEniCS or dolfinx, which keeps no values at nodes; write the displacement with "
            "XDMFFile.write_function or VTKFile"
        )
    return f"is an HDF5 file of a layout that is not known (it holds {', '.join(sorted(names)[:5]) or 'nothing'})"


def _named(path: Path, text: str) -> str:
    return f"({path.name}) {text}"
