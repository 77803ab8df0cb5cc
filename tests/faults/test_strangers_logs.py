"""Logs of strangers: what they say of their sizes is not believed, and nothing but themselves is read."""

import io
import os
import zipfile

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import SECRET, answers, require_refusal
from mcap.writer import CompressionType, Writer

from own_robots import CART, CART_SPEC, write_robot

ROWS = 40
BILLIONS = 2_000_000_000


def columns():
    """A log of the cart that can be checked."""
    time = 0.02 * np.arange(ROWS)
    return {"time": time, "place": np.sin(time), "speed": np.cos(time), "push": np.sin(7 * time)}


def header(shape):
    """The beginning of an array in an npz file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def npz_that_says_more(path):
    np.savez(path, **{name: values for name, values in columns().items() if name != "push"})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("push.npy", header((BILLIONS,)) + b"\0" * 80)


def npz_of_zeros(path):
    np.savez(path, **{name: values for name, values in columns().items() if name != "push"})
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("push.npy", "w", force_zip64=True) as member,
    ):
        member.write(header((70_000_000,)))
        for _ in range(56):
            member.write(bytes(10_000_000))


def hdf5(change):
    """A writer of an HDF5 log, in which something is changed."""

    def write(path):
        with h5py.File(path, "w") as file:
            for name, values in columns().items():
                file[name] = values
            change(file, path)

    return write


def large(name, rows=BILLIONS):
    """Makes a column of very many rows of nothing."""

    def change(file, path):
        if name in file:
            del file[name]
        file.create_dataset(name, (rows,), "f8", chunks=(1_000_000,), compression="gzip")

    return change


def external(target):
    def change(file, path):
        del file["push"]
        file.create_dataset("push", (3,), "u1", external=[(str(path.parent / target), 0, 3)])

    return change


def linked(file, path):
    del file["push"]
    with h5py.File(path.parent / "secret.h5", "w") as other:
        other["push"] = columns()["push"]
    file["push"] = h5py.ExternalLink(str(path.parent / "secret.h5"), "push")


def virtual(file, path):
    linked(file, path)
    del file["push"]
    layout = h5py.VirtualLayout((ROWS,), "f8")
    layout[:] = h5py.VirtualSource(str(path.parent / "secret.h5"), "push", shape=(ROWS,))
    file.create_virtual_dataset("push", layout)


def parquet_of_one_text(name):
    def write(path):
        text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10_000, np.int32)), pa.array(["a" * 1_000_000]))
        rows = {key: np.resize(values, len(text)) for key, values in columns().items() if key != name}
        rows["time"] = 0.02 * np.arange(len(text))
        pq.write_table(pa.table({**rows, name: text}), path, store_schema=False)

    return write


def parquet_of_zeros(path):
    schema = pa.schema([(name, pa.float64()) for name in columns()])
    with pq.ParquetWriter(path, schema) as writer:
        part = pa.table({name: np.zeros(5_000_000) for name in columns()})
        for _ in range(5):
            writer.write_table(part)


def mcap(messages, **options):
    def write(path):
        with path.open("wb") as file:
            writer = Writer(file, **options)
            writer.start()
            channel = writer.register_channel("/a", "json", 0)
            for row, message in enumerate(messages()):
                writer.add_message(channel, row * 20_000_000, message, row * 20_000_000)
            writer.finish()

    return write


def large_chunk():
    yield b'{"x": 1}' + b" " * 300_000_000


REFUSED = {
    "says-more.npz": (npz_that_says_more, "damaged"),
    "zeros.npz": (npz_of_zeros, "at most 500,000,000"),
    "says-more.h5": (hdf5(large("push")), "at most 500,000,000"),
    "elsewhere.h5": (hdf5(external("secret.txt")), "another file"),
    "pipe.h5": (hdf5(external("pipe")), "another file"),
    "linked.h5": (hdf5(linked), "another file"),
    "virtual.h5": (hdf5(virtual), "another file"),
    "text.parquet": (parquet_of_one_text("push"), "at most 500,000,000"),
    "zeros.parquet": (parquet_of_zeros, "at most 500,000,000"),
    "chunk.mcap": (mcap(large_chunk, compression=CompressionType.ZSTD, chunk_size=2**30), "200,000,000"),
    "chunk-lz4.mcap": (mcap(large_chunk, compression=CompressionType.LZ4, chunk_size=2**30), "200,000,000"),
    "picture.mcap": (mcap(lambda: [b"[" + b"1," * 3_000_000 + b"1]"]), "no column 'place'"),
    "digits.mcap": (mcap(lambda: [b'{"x": 1' + b"0" * 400 + b"}"] * 3), "no column 'place'"),
    "pipe.csv": (os.mkfifo, "no file"),
}
UNREAD = {
    "unread.npz": npz_of_zeros,
    "unread.h5": hdf5(large("camera")),
    "unread.parquet": parquet_of_one_text("note"),
}
"""Logs with a huge column that nobody has asked for."""


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The answer of `madoc check` to each log, by its name; all in one process."""
    root = tmp_path_factory.mktemp("logs")
    (root / "secret.txt").write_text(SECRET)
    os.mkfifo(root / "pipe")
    spec = write_robot(root, CART_SPEC, cart=CART)
    lines = {}
    for name, write in [*((name, write) for name, (write, _) in REFUSED.items()), *UNREAD.items()]:
        write(root / name)
        asked = spec
        if name == "unread.npz":  # its zeros are in `push`
            asked = root / "other.yaml"
            asked.write_text(CART_SPEC.replace("name: push", "name: pull", 1))
            np.savez(root / "rest.npz", pull=columns()["push"])
            with zipfile.ZipFile(root / "rest.npz") as rest, zipfile.ZipFile(root / name, "a") as archive:
                archive.writestr("pull.npy", rest.read("pull.npy"))
        lines[name] = ["check", asked, "--data", root / name, "--no-forecast"]
    return dict(zip(lines, answers(lines.values()), strict=True))


@pytest.mark.parametrize("name", REFUSED)
def test_a_log_that_is_larger_than_it_looks_or_reads_other_files_is_refused(answered, name):
    require_refusal(answered[name], REFUSED[name][1])


@pytest.mark.parametrize("name", UNREAD)
def test_columns_that_nobody_asks_for_are_not_read(answered, name):
    answer = answered[name]
    assert answer["code"] in (0, 2), answer
    assert "rows in 1 run" in answer["out"], answer
    assert answer["memory"] < 1e9
