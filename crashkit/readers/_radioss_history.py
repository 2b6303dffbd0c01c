"""The OpenRadioss time history NAMET01: big-endian records, each between two copies of its length.

A head says what is written: global variables, parts, materials, properties, subsets, and groups of nodes, walls,
sensors and the like, each with its objects and its variables. Then every sample is one record with the time, one with
the global variables, one with those of all parts, one with those of subsets (where there are any), and one for each
group. Which letter stands for which variable is only in the deck, so groups whose variables are the default set are
told by their kind; others are numbered.

Forces of walls, interfaces and sections are written as impulses, summed up from the start: they are differentiated, and
say so.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers._names import field_name
from crashkit.readers.history import Channel, History, distinct, rate_of

# In the order in which they are written; a file may hold fewer.
_GLOBAL = (
    ("internal_energy", "energy"), ("kinetic_energy", "energy"), ("x_momentum", "momentum"), ("y_momentum", "momentum"),
    ("z_momentum", "momentum"), ("mass", "mass"), ("time_step", "time"), ("rotation_energy", "energy"),
    ("external_work", "energy"), ("spring_energy", "energy"), ("contact_energy", "energy"),
    ("hourglass_energy", "energy"), ("elastic_contact_energy", "energy"), ("frictional_contact_energy", "energy"),
    ("damping_contact_energy", "energy"), ("plastic_work", "energy"), ("added_mass", "mass"),
    ("added_mass_percent", "one"),
)  # fmt: skip
# By their number in the head; the others are energies of rigid bodies, heat and the like.
_PART = {
    1: ("internal_energy", "energy"), 2: ("kinetic_energy", "energy"), 3: ("x_momentum", "momentum"),
    4: ("y_momentum", "momentum"), 5: ("z_momentum", "momentum"), 6: ("mass", "mass"), 7: ("hourglass_energy", "energy"),
    9: ("x_centre", "length"), 10: ("y_centre", "length"), 11: ("z_centre", "length"),
}  # fmt: skip
_NODE = tuple(
    (f"{what}_{axis}", what) for what in ("displacement", "velocity", "acceleration") for axis in "xyz"
)  # fmt: skip
_FORCES = tuple((f"{kind}_force_{axis}", "force") for kind in ("normal", "tangential") for axis in "xyz")
_ACCELERATIONS = tuple((f"acceleration_{axis}", "acceleration") for axis in "xyz")
# Kind of a group -> names of its variables by number; and whether they are impulses.
_NODES, _WALL, _INTERFACE, _SECTION, _ACCELEROMETER = 0, 102, 101, 104, 108
_GROUPS = {_NODES: _NODE, _WALL: _FORCES, _INTERFACE: _FORCES, _SECTION: _FORCES, _ACCELEROMETER: _ACCELERATIONS}
_IMPULSES = {_WALL, _INTERFACE, _SECTION}
_TOLD = "derivative of the impulse that the solver writes"
# Versions from which titles are longer, and from which two more records stand in the head.
_TITLES = ((4021, 100), (3041, 80), (0, 40))
_MORE_HEAD = 3050


@dataclass(frozen=True)
class _Group:
    kind: int
    title: str
    objects: tuple[tuple[int, str], ...]
    variables: tuple[int, ...]


class _Records:
    """The records of a file, one after the other."""

    def __init__(self, file: Path) -> None:
        self.file, self.place = file, 0
        try:
            self.data = file.read_bytes()
        except OSError as error:
            raise ReadError(f"{file}: cannot be read ({error.strerror or error})") from error

    def more(self) -> bool:
        return self.place < len(self.data)

    def next(self, what: str) -> bytes:
        start = self.place
        if start + 4 > len(self.data):
            raise self._broken(what, start)
        (size,) = struct.unpack_from(">i", self.data, start)
        end = start + 4 + size
        if size < 0 or end + 4 > len(self.data) or struct.unpack_from(">i", self.data, end)[0] != size:
            raise self._broken(what, start)
        self.place = end + 4
        return self.data[start + 4 : end]

    def integers(self, what: str) -> tuple[int, ...]:
        body = self.next(what)
        return struct.unpack(f">{len(body) // 4}i", body[: len(body) // 4 * 4])

    def _broken(self, what: str, place: int) -> ReadError:
        return ReadError(
            f"{self.file}: {what} at byte {place} of {len(self.data)} is no whole record; the file is cut short or damaged"
        )


def read_history(file: Path) -> History:
    """The curves of one T01 file.

    A file that was cut short within a sample gives the samples before it.

    Raises
    ------
    ReadError
        Where it is none, or where its head is damaged.
    """
    records = _Records(file)
    try:
        return _history(file, records)
    except struct.error as error:
        raise ReadError(
            f"{file}: the record before byte {records.place} of {len(records.data)} is shorter than its kind ({error}); the "
            "file is cut short or damaged, copy it again"
        ) from error


def _history(file: Path, records: _Records) -> History:
    head = records.next("the title")
    (version,) = struct.unpack_from(">i", head.ljust(4, b"\0"))
    if not 2000 <= version <= 9999:
        raise ReadError(f"{file}: begins with {version}, which is no version of a time history; expected such as 4021")
    width = next(w for least, w in _TITLES if version >= least)
    records.next("the date")
    if version > _MORE_HEAD:
        records.next("the number of further records")
        records.next("the length of titles")
        records.next("the units")
    counts = records.integers("the counts")
    if len(counts) < 6 or min(counts[:6]) < 0:
        raise ReadError(f"{file}: says {counts} where six counts are expected; it is no time history, or damaged")
    parts, materials, properties, subsets, groups, global_count = counts[:6]
    if global_count:
        records.next("the global variables")
    channels = [Channel(*_global(k)) for k in range(global_count)]
    part_channels = _parts(records, parts, width)
    for k in range(materials + properties):
        records.next(f"material or property {k + 1}")
    subset_channels = _subsets(records, subsets, width)
    found = [_group(records, k, width) for k in range(groups)]
    sizes = [
        len(channels),
        len(part_channels),
        len(subset_channels),
        *(len(g.objects) * len(g.variables) for g in found),
    ]
    time, rows = _samples(records, sizes)
    values = np.array(rows, np.float64).reshape(len(time), sum(sizes))
    channels += [*part_channels, *subset_channels, *_of_groups(found)]
    impulses = [k for k, c in enumerate(channels) if c.derived]
    values[:, impulses] = rate_of(time, values[:, impulses])
    return History(time, distinct(channels), values)


def _samples(records: _Records, sizes: list[int]) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    times: list[float] = []
    rows: list[NDArray[np.float64]] = []
    while records.more():
        try:
            (time,) = struct.unpack(">f", records.next("the time of a sample"))
            pieces = [np.frombuffer(records.next("a sample"), ">f4") for size in sizes if size]
        except (ReadError, struct.error):
            break  # the last sample was being written
        if [len(p) for p in pieces] != [s for s in sizes if s]:
            raise ReadError(
                f"{records.file}: sample {len(times) + 1} holds {[len(p) for p in pieces]} values, the head says "
                f"{[s for s in sizes if s]}; the file is damaged"
            )
        if times and time <= times[-1]:  # a restart wrote its first sample again
            continue
        times.append(time)
        rows.append(np.concatenate(pieces).astype(np.float64) if pieces else np.empty(0))
    if not times:
        raise ReadError(f"{records.file}: holds no whole sample; the run was stopped at once, or the file is cut short")
    return np.array(times, np.float64), rows


def _global(number: int) -> tuple[str, str]:
    return _GLOBAL[number] if number < len(_GLOBAL) else (f"global_{number + 1}", "unknown")


def _parts(records: _Records, count: int, width: int) -> list[Channel]:
    out = []
    for k in range(count):
        body = records.next(f"part {k + 1}")
        title = _text(body[4 : 4 + width])
        (variables,) = struct.unpack_from(">i", body, len(body) - 4)
        for number in records.integers(f"the variables of part {k + 1}") if variables else ():
            name, quantity = _PART.get(number, (f"variable_{number}", "unknown"))
            out.append(Channel(f"{_word(title, f'part_{k + 1}')}_{name}", quantity))
    return out


def _subsets(records: _Records, count: int, width: int) -> list[Channel]:
    out = []
    for k in range(count):
        body = records.next(f"subset {k + 1}")
        _, _, subsets, parts, variables = struct.unpack_from(">5i", body)
        title = _text(body[20 : 20 + width])
        for what, size in (("subsets", subsets), ("parts", parts)):
            if size:
                records.next(f"the {what} of subset {k + 1}")
        for number in records.integers(f"the variables of subset {k + 1}") if variables else ():
            name, quantity = _PART.get(number, (f"variable_{number}", "unknown"))
            out.append(Channel(f"{_word(title, f'subset_{k + 1}')}_{name}", quantity))
    return out


def _group(records: _Records, place: int, width: int) -> _Group:
    body = records.next(f"group {place + 1}")
    _, kind, _, objects, _ = struct.unpack_from(">5i", body)
    title = _text(body[20 : 20 + width])
    named = []
    for k in range(objects):
        row = records.next(f"object {k + 1} of group {title!r}")
        named.append((struct.unpack_from(">i", row)[0], _text(row[4 : 4 + width])))
    return _Group(kind, title, tuple(named), records.integers(f"the variables of group {title!r}"))


def _of_groups(groups: list[_Group]) -> list[Channel]:
    """The channels of all groups; where two groups have one name, both carry their group's in front."""
    out = [(group, channel) for group in groups for channel in _channels_of(group)]
    often = Counter(channel.name for _, channel in out)
    return [
        replace(c, name=f"{_word(group.title, f'group_{group.kind}')}_{c.name}") if often[c.name] > 1 else c
        for group, c in out
    ]


def _channels_of(group: _Group) -> list[Channel]:
    known = _GROUPS.get(group.kind, ())
    out = []
    for number, title in group.objects:
        own = _word(title, f"{_word(group.title, 'group')}_{number}")
        for variable in group.variables:
            if 1 <= variable <= len(known):
                name, quantity = known[variable - 1]
                impulse = group.kind in _IMPULSES
                out.append(Channel(f"{own}_{name}", quantity, _TOLD if impulse else ""))
            else:
                out.append(Channel(f"{own}_variable_{variable}", "unknown"))
    return out


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("latin-1").strip()


def _word(title: str, otherwise: str) -> str:
    return field_name(title) or otherwise
