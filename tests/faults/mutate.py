"""Seeded damage to files: what disks, transfers, other programs and hostile people make of them.

:func:`mutations` takes the bytes of a sound file and yields damaged ones without end. Half of them are
damaged as bytes, whatever their meaning; half within their format (``kind``), so that the damage gets past
checksums and parsers: values of JSON and YAML, cells of CSV, members of zip files, datasets of HDF5.
"""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np
import torch
import yaml

__all__ = ["KINDS", "mutations"]

#: Values that no reader expects.
HOSTILE: list[Any] = [
    None, True, -1, 0, 1, 2**31, 2**63, -(2**64), 10**400, 0.5, -0.0, 1e308, 1e-320, float("nan"),
    "", " ", "0", "a" * 3000, "é\u202e\x00\x1b[31m", "../../../etc/passwd", "=1+1", "${oc.env:HOME}", "1e999",
    [], {}, [[]], [[[[[[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]]]]]], [None] * 300, {"a": {"b": {"c": -1}}},
    float("inf"), [1, "a"], "2001-99-99", "0x", "._", "1:1:1", "<<", "no", "~",
]  # fmt: skip
#: Text that parsers stumble over.
TOKENS = [
    "[" * 3000, "{" * 3000, '{"a":' * 3000, "&a [*a]", "&a {x: 1, <<: *a}", "!!python/object:os.system {}",
    "!!int x", "<<: [*a, *a]", "\x00", "\ufeff", "\r", "\n\n", '"', "'", ",", ":", "- ", "? ", "---\n", "...",
    "%YAML 9.9\n", "\t", "9" * 6000, "1:" * 2000, ".inf", "NaN", "-Infinity", "null", "=", "*", "\ud800", ";",
    "a,b,c,d,e,f,g,h,i,j,k",
    "a: &a [1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b]\nd: [*c,*c,*c]",
]  # fmt: skip


def _bytes(data: bytes, rng: random.Random) -> bytes:
    """Damage bytes, one to four times."""
    damaged = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        place = rng.randrange(len(damaged)) if damaged else 0
        length = min(rng.choice([1, 2, 4, 8, 64, 512]), len(damaged) - place)
        match rng.randrange(9):
            case 0 if damaged:
                damaged[place] ^= 1 << rng.randrange(8)
            case 1 if damaged:
                damaged[place] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)])
            case 2:
                del damaged[place:]
            case 3:
                del damaged[place : place + length]
            case 4:
                damaged[place:place] = rng.randbytes(length)
            case 5:
                damaged[place:place] = damaged[place : place + length] * rng.choice([1, 1, 100])
            case 6:
                damaged[place : place + length] = bytes([rng.choice([0, 0xFF])]) * length
            case 7:
                number = rng.choice([0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1])
                damaged[place : place + 4] = struct.pack(rng.choice("<>") + "I", number)
            case _:
                number = rng.choice([2**40, 2**62, 2**63, 2**64 - 1])
                damaged[place : place + 8] = struct.pack(rng.choice("<>") + "Q", number)
    return bytes(damaged)


def _token(data: bytes, rng: random.Random) -> bytes:
    """Put a hostile token into text, or in the place of a word or of all of it."""
    text, token = data.decode("utf-8", "replace"), rng.choice(TOKENS)
    first = rng.randrange(len(text) + 1)
    last = min(len(text), first + rng.choice([0, 0, 1, 5, len(text)]))
    return (text[:first] + token + text[last:]).encode("utf-8", "surrogatepass")


def _value(value: Any, rng: random.Random) -> Any:
    """Plain data with one value replaced, left out, or added."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        key = rng.choice(list(value))
        changed = dict(value)
        if rng.random() < 0.15:
            del changed[key]
        elif rng.random() < 0.1:
            changed[str(rng.choice(HOSTILE))] = rng.choice(HOSTILE)
        else:
            changed[key] = _value(value[key], rng)
        return changed
    if isinstance(value, list) and value and rng.random() < 0.8:
        place, changed = rng.randrange(len(value)), list(value)
        if rng.random() < 0.2:
            return (
                changed[:place] + changed[place : place + 1] * rng.choice([0, 2, 2000]) + changed[place + 1 :]
            )
        changed[place] = _value(value[place], rng)
        return changed
    return rng.choice(HOSTILE)


def _json(data: bytes, rng: random.Random) -> bytes:
    return json.dumps(_value(json.loads(data), rng)).encode()


def _checkpoint(data: bytes, rng: random.Random) -> bytes:
    """One value of a checkpoint replaced, or one of its tensors by another."""
    state = torch.load(io.BytesIO(data), weights_only=True)
    place, key = state, rng.choice(list(state))
    while isinstance(place[key], dict) and place[key] and rng.random() < 0.8:
        place = place[key]
        key = rng.choice(list(place))
    value = place[key]
    if isinstance(value, torch.Tensor) and rng.random() < 0.7:
        nan = torch.full_like(value.float(), float("nan"))
        lost, huge = value.flatten()[:-1].clone(), torch.full_like(value, 127)
        place[key] = rng.choice(
            [nan, lost, huge, value.unsqueeze(0).clone(), value.double(), value.expand(2, *value.shape)]
        )
    elif rng.random() < 0.2:
        del place[key]
    else:
        place[key] = rng.choice([_value(value, rng), torch.zeros(3), torch.zeros(2, 0), b"x"])
    file = io.BytesIO()
    torch.save(state, file)
    return file.getvalue()


def _yaml(data: bytes, rng: random.Random) -> bytes:
    return yaml.safe_dump(_value(yaml.safe_load(data), rng)).encode("utf-8", "surrogatepass")


def _csv(data: bytes, rng: random.Random) -> bytes:
    """One cell replaced, left out or doubled, or lines changed places."""
    rows = [line.split(",") for line in data.decode().split("\n")]
    row = rng.choice(rows)
    place = rng.randrange(len(row))
    match rng.randrange(4):
        case 0:
            del row[place]
        case 1:
            row[place:place] = row[place : place + 1] * rng.choice([1, 2000])
        case 2:
            rng.shuffle(rows)
        case _:
            row[place] = str(rng.choice(HOSTILE))
    return "\n".join(",".join(row) for row in rows).encode("utf-8", "surrogatepass")


def _zip(data: bytes, rng: random.Random) -> bytes:
    """A sound archive of damaged members, or of members left out, renamed or compressed otherwise."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(info.filename, file.read(info)) for info in file.infolist()]
    place = rng.randrange(len(members))
    name, content = members[place]
    method = zipfile.ZIP_DEFLATED
    match rng.randrange(8):
        case 0:
            del members[place]
        case 1:
            members[place] = (str(rng.choice(HOSTILE))[:100], content)
        case 2:
            members[place] = (name, content + bytes(rng.choice([1, 10**5, 10**7])))
        case 3:
            members[place] = (name, b"")
        case 4:
            method = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
        case 5 if content.startswith(b"\x93NUMPY"):
            members[place] = (name, _npy(content, rng))
        case _:
            members[place] = (name, _bytes(content, rng))
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", method) as file:
        for member, bytes_of_it in members:
            file.writestr(member, bytes_of_it)
    return written.getvalue()


def _npy(data: bytes, rng: random.Random) -> bytes:
    """An array of another type or shape, or one whose header lies."""
    array = np.load(io.BytesIO(data))
    changes: list[Callable[[], np.ndarray]] = [
        lambda: array.astype(rng.choice(["f8", "i1", "u8", "c16", "S3", "U5", "?", "M8[s]"])),
        lambda: array[..., None],
        lambda: array.ravel()[: rng.randrange(3)],
        lambda: np.full(array.shape, rng.choice([-1, 2**31, 2**62])),
        lambda: np.full(array.shape, rng.choice([np.nan, np.inf, -1e300])),
        lambda: np.array(rng.choice(["x" * 50, -5, True, 2.5])),
    ]
    written = io.BytesIO()
    np.save(written, rng.choice(changes)(), allow_pickle=False)
    content = written.getvalue()
    if rng.random() < 0.5:
        lie = rng.choice(
            [b"(99999999999,)", b"(-1,)", b"(1, 1, 1, 1, 1, 1, 1)", b"(True,)", b"((((((", b"(10**9,)"]
        )
        first, last = content.index(b"(", 10), content.index(b")", 10) + 1
        length = last - first
        content = content[:first] + lie.ljust(length)[: max(length, len(lie))] + content[last:]
    return content


def _hdf5(data: bytes, rng: random.Random) -> bytes:
    """A sound HDF5 file with a dataset or attribute of another kind, or that declares too much."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "a") as file:
        name = rng.choice([*file, "extra"])
        old = file[name][()] if name in file else np.zeros((5, 2))
        if rng.random() < 0.2:
            hostile: list[Any] = [
                "x" * 3000,
                -1,
                [],
                np.arange(3000),
                h5py.Empty("f4"),
                [b"\xff\xfe"],
                [True],
                name,
            ]
            file.attrs[rng.choice(["actions", "scene", "seed", "licences", "other"])] = rng.choice(hostile)
            return _closed(file, buffer)
        if name in file:
            del file[name]
        match rng.randrange(10):
            case 0:
                file[name] = h5py.SoftLink(rng.choice([name, "/", "/nowhere", "/graph"]))
            case 1:
                file[name] = h5py.ExternalLink(rng.choice(["/dev/zero", "/etc/passwd", "."]), "/" + name)
            case 2:
                file.create_dataset(
                    name, (5, 1, 1, 3), "u1", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
                )
            case 3:
                shape = rng.choice(
                    [(5, 10**6, 10**5), (10**12,), (20_000, 20_000), (5, 4000, 4000, 3), (5, 10**9)]
                )
                file.create_dataset(name, shape, rng.choice(["f4", "i8", "u1"]), chunks=True, compression=9)
            case 4:
                file.create_group(name)["graph"] = np.zeros(3)
            case 5:
                file.create_virtual_dataset(name, h5py.VirtualLayout((5, 2), "f4"))
            case 6 if old.dtype.kind in "iuf":
                with np.errstate(all="ignore"):
                    file[name] = np.full_like(
                        old, rng.choice([0, 1, 127, np.nan if old.dtype.kind == "f" else 3])
                    )
            case 7 if old.dtype.kind in "iuf":
                file[name] = rng.choice([old[..., None], old[:0], old[:1], old.ravel(), old[()].sum(), old.T])
            case 8:
                file[name] = rng.choice(
                    [np.bytes_("text"), np.array([b"a", b"bc"]), np.zeros(5, "f2,i4"), 1 + 2j, True]
                )
            case _:
                item = np.frombuffer(rng.randbytes(rng.choice([0, 1, 100])), np.uint8)
                dataset = file.create_dataset(name, (5,), h5py.vlen_dtype(np.uint8))
                dataset[0] = item
        return _closed(file, buffer)


def _closed(file: h5py.File, buffer: io.BytesIO) -> bytes:
    file.close()
    return buffer.getvalue()


#: How a file is damaged within its format.
def _safetensors(data: bytes, rng: random.Random) -> bytes:
    """A value of the header, or of the JSON text that an agent's header holds, replaced."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    if rng.random() < 0.7:
        inner = json.loads(header["__metadata__"]["vusfa"])
        header["__metadata__"]["vusfa"] = json.dumps(_value(inner, rng))
    else:
        header = _value(header, rng)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


KINDS: dict[str, list[Callable[[bytes, random.Random], bytes]]] = {
    "bytes": [_bytes],
    "jpeg": [_bytes],
    "text": [_token],
    "json": [_json, _json, _token],
    "yaml": [_yaml, _yaml, _token],
    "csv": [_csv, _csv, _token],
    "zip": [_zip],
    "npz": [_zip],
    "npy": [_npy],
    "hdf5": [_hdf5],
    "safetensors": [_safetensors],
    "checkpoint": [_checkpoint, _checkpoint, _zip],
}


def mutations(data: bytes, rng: random.Random, kind: str = "bytes") -> Iterator[bytes]:
    """Damaged forms of a file, without end; the same for the same seed.

    Args:
        data: a sound file.
        rng: decides on all of it.
        kind: format of the file, of :data:`KINDS`.
    """
    while True:
        damage = _bytes if rng.random() < 0.5 else rng.choice(KINDS[kind])
        yield damage(data, rng)
