"""Every format is written here and read back to the same numbers."""

import json
import sys
import warnings
import zipfile

import gymnasium
import h5py
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logged_arm import ACTIONS, SIGNALS, arm_of, assert_same, matrix, named, write_csv

from madoc.data import logs
from madoc.data.findings import Finding
from madoc.data.logs import parquet_reader
from madoc.data.logs.messages import read_mcap
from madoc.errors import MadocError


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv(robot, columns, tmp_path, separator):
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns, separator), robot)
    assert_same(dataset, columns)
    assert dataset.run_names == ("log.csv",)
    assert dataset.findings == ()


def test_csv_with_text_in_other_columns_quotes_and_a_byte_order_mark(robot, columns, tmp_path):
    lines = write_csv(tmp_path / "plain.csv", columns).read_text().splitlines()
    lines = [f'"mode, set",{lines[0]}', *(f'"auto, slow",{line}' for line in lines[1:])]
    file = tmp_path / "log.csv"
    file.write_text("\ufeff# recorded by hand\n" + "\n".join(lines) + "\n\n")
    assert_same(logs.read(file, robot), columns)


def test_csv_as_numpy_writes_it(robot, columns, tmp_path):
    file = tmp_path / "log.csv"
    np.savetxt(file, np.stack(list(columns.values()), axis=-1), delimiter=",", header=",".join(columns), fmt="%.17g")
    assert_same(logs.read(file, robot), columns)


def test_npz(robot, columns, tmp_path):
    np.savez(tmp_path / "log.npz", **columns, serial_number=np.array(7))
    assert_same(logs.read(tmp_path / "log.npz", robot), columns)


def test_npz_of_matrices(columns, tmp_path):
    robot = arm_of(tmp_path, log=named("seen", "done", "t"))
    np.savez(tmp_path / "log.npz", seen=matrix(columns, SIGNALS), done=matrix(columns, ACTIONS), t=columns["time"])
    assert_same(logs.read(tmp_path / "log.npz", robot), columns)


def test_hdf5(robot, columns, tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
        file["camera/images"] = np.zeros((50, 4, 4, 3), np.uint8)
    assert_same(logs.read(tmp_path / "log.h5", robot), columns)


def test_hdf5_with_a_group_a_run(columns, tmp_path):
    robot = arm_of(tmp_path, log=named("obs/state", "actions", "stamps"))
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        for name in ("demo_10", "demo_2"):
            file[f"data/{name}/obs/state"] = matrix(columns, SIGNALS) + (name == "demo_10")
            file[f"data/{name}/actions"] = matrix(columns, ACTIONS)
            file[f"data/{name}/stamps"] = columns["time"]
    dataset = logs.read(tmp_path / "log.hdf5", robot)
    assert dataset.run_names == ("log.hdf5/data/demo_2", "log.hdf5/data/demo_10")
    assert dataset.episode_starts.tolist() == [0, 49]
    np.testing.assert_array_equal(dataset.transitions.observation[49:], dataset.transitions.observation[:49] + 1)


def test_parquet(robot, columns, tmp_path):
    pq.write_table(pa.table({**columns, "label": ["a"] * 50}), tmp_path / "log.parquet")
    assert_same(logs.read(tmp_path / "log.parquet", robot), columns)


def test_parquet_of_lists_and_dates(columns, tmp_path):
    robot = arm_of(tmp_path, log=named("seen", "done", "at"))
    nanoseconds = 1_700_000_000_000_000_000 + np.arange(50) * 20_000_000
    lists = {"seen": matrix(columns, SIGNALS).tolist(), "done": matrix(columns, ACTIONS).tolist()}
    pq.write_table(pa.table({**lists, "at": pa.array(nanoseconds, pa.timestamp("ns"))}), tmp_path / "log.parquet")
    assert_same(logs.read(tmp_path / "log.parquet", robot), columns)


@pytest.mark.parametrize("kind", [pa.list_(pa.float64()), pa.list_(pa.float64(), 2), pa.large_list(pa.float64())])
def test_parquet_of_lists_with_missing_rows(tmp_path, kind):
    file = tmp_path / "log.parquet"
    pq.write_table(pa.table({"pair": pa.array([[1.0, 2.0], None, [3.0, 4.0]], kind)}), file, row_group_size=1)
    read, _ = parquet_reader.read_columns(file, {"pair"})
    np.testing.assert_array_equal(read["pair"], [[1, 2], [np.nan, np.nan], [3, 4]])
    pq.write_table(pa.table({"pair": pa.array([], kind)}), file)
    assert parquet_reader.read_columns(file, {"pair"})[0]["pair"].size == 0


def test_parquet_of_lists_of_unequal_lengths(tmp_path):
    pq.write_table(pa.table({"pair": [[1.0, 2.0], [3.0]]}), tmp_path / "log.parquet")
    with pytest.raises(MadocError, match=r"as many values in every row of a list column of log.parquet, got 1 and 2"):
        parquet_reader.read_columns(tmp_path / "log.parquet", {"pair"})


def lerobot(folder, columns, *, together):
    """Two episodes, of one file each (version 2) or of one file (version 3)."""
    tables = []
    for episode in (0, 1):
        tables.append(
            pa.table(
                {
                    "observation.state": (matrix(columns, SIGNALS) + episode).astype(np.float32).tolist(),
                    "action": matrix(columns, ACTIONS).astype(np.float32).tolist(),
                    "timestamp": columns["time"].astype(np.float32),
                    "frame_index": np.arange(50),
                    "episode_index": np.full(50, episode),
                }
            )
        )
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if together:
        pq.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for episode, table in enumerate(tables):
            pq.write_table(table, chunk / f"episode_{episode:06d}.parquet")
    features = {
        "observation.state": {"dtype": "float32", "shape": [4], "names": {"motors": list(SIGNALS)}},
        "action": {"dtype": "float32", "shape": [2], "names": list(ACTIONS)},
    }
    (folder / "meta").mkdir()
    information = {"codebase_version": "v3.0" if together else "v2.1", "fps": 50, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(information))


@pytest.mark.parametrize("together", [False, True])
def test_lerobot(columns, tmp_path, together):
    pairs = [f"{name}: 'observation.state[{name}]'" for name in SIGNALS]
    pairs += [f"{name}: 'action[{name}]'" for name in ACTIONS]
    robot = arm_of(tmp_path, log=f"{{columns: {{{', '.join(pairs)}}}}}")
    lerobot(tmp_path / "logs", columns, together=together)
    dataset = logs.read(tmp_path / "logs", robot)
    assert dataset.run_names == ("logs/episode_0", "logs/episode_1")
    assert dataset.episode_starts.tolist() == [0, 49]
    expected = matrix(columns, SIGNALS)[:-1].astype(np.float32)
    np.testing.assert_array_equal(dataset.transitions.observation[:49], expected)
    np.testing.assert_allclose(dataset.transitions.observation[49:], expected + 1, rtol=1e-6)


def test_lerobot_in_files_of_many_episodes_with_their_list_beside(columns, tmp_path):
    """Version 3.0 as its library writes it: lists of a fixed length, several files, a table of episodes."""
    lerobot(tmp_path / "logs", columns, together=True)
    chunk = tmp_path / "logs" / "data" / "chunk-000"
    table = pq.read_table(chunk / "file-000.parquet")
    for name, width in (("observation.state", 4), ("action", 2)):
        place = table.schema.get_field_index(name)
        table = table.set_column(place, name, table.column(name).cast(pa.list_(pa.float32(), width)))
    for file in (0, 1):  # 25 rows of the second episode are in each
        pq.write_table(table.slice(75 * file, 75 - 50 * file), chunk / f"file-{file:03d}.parquet")
    episodes = tmp_path / "logs" / "meta" / "episodes" / "chunk-000"
    episodes.mkdir(parents=True)
    pq.write_table(pa.table({"episode_index": [0, 1], "length": [50, 50]}), episodes / "file-000.parquet")
    robot = arm_of(tmp_path, log=named("observation.state", "action"))
    dataset = logs.read(tmp_path / "logs", robot)
    assert dataset.run_names == ("logs/episode_0", "logs/episode_1") and dataset.episode_starts.tolist() == [0, 49]
    expected = matrix(columns, SIGNALS)[:-1].astype(np.float32)
    np.testing.assert_allclose(dataset.transitions.observation, np.concatenate([expected, expected + 1]), rtol=1e-6)


@pytest.mark.parametrize("separator", [", ", " "])
def test_csv_with_lists_in_its_cells(columns, tmp_path, separator):
    def cells(names):
        return [f'"[{separator.join(repr(float(columns[name][row])) for name in names)}]"' for row in range(50)]

    times = map(repr, columns["time"].tolist())
    rows = zip(times, cells(SIGNALS), cells(ACTIONS), strict=True)
    file = tmp_path / "log.csv"
    file.write_text("\n".join(["time,state,action", *map(",".join, rows)]))
    robot = arm_of(tmp_path, log=named("state", "action"))
    assert_same(logs.read(file, robot), columns)
    file.write_text(file.read_text() + '\n1.0,,"[0.0 0.0]"')  # a list that is missing
    with pytest.raises(
        MadocError, match=r"as many values in every list of column 'action'.* 2 in line 52 and 3 in line 53"
    ):
        logs.read(_with(file, '\n1.02,,"[0.0 0.0 0.0]"'), robot)
    with pytest.raises(MadocError, match=r"expected a number in column 'action\[1\]' of more.csv, got 'x' in line 53"):
        logs.read(_with(file, '\n1.02,,"[0.0 x]"'), robot)


def _with(file, text):
    """The file with something behind it, beside it."""
    more = file.with_name("more.csv")
    more.write_text(file.read_text() + text)
    return more


def test_minari(columns, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    robot = arm_of(tmp_path, log=named("observations", "actions"))
    seen, done = matrix(columns, SIGNALS), matrix(columns, ACTIONS)
    flags = np.zeros(49, bool)
    buffer = minari.data_collector.EpisodeBuffer(
        observations=seen,
        actions=done[:-1],
        rewards=np.zeros(49),
        terminations=flags,
        truncations=np.append(flags[1:], True),
    )
    warnings.simplefilter("ignore")  # Minari would like an environment to go with it
    minari.create_dataset_from_buffers(
        "arm/test-v0",
        [buffer],
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64),
        action_space=gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64),
        author="a test",
        author_email="none",
        code_permalink="none",
        algorithm_name="none",
        eval_env=None,
        description="none",
    )
    dataset = logs.read(tmp_path / "minari" / "arm" / "test-v0", robot)
    assert_same(dataset, columns)
    assert dataset.findings == (
        Finding("note", "its format keeps no times: rows are taken to be 0.02 s apart", "test-v0/episode_0"),
    )


def test_a_zip_archive_of_other_files_is_refused(robot, tmp_path):
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("method.json", "{}")
    with pytest.raises(MadocError, match=r"only arrays in .*log.npz, got the file 'method.json'"):
        logs.read(tmp_path / "log.npz", robot)


@pytest.mark.parametrize(
    ("read", "package", "file"),
    [(parquet_reader.read, "pyarrow", "log.parquet"), (read_mcap, "mcap.reader", "log.mcap")],
)
def test_a_missing_extra_names_its_command(tmp_path, monkeypatch, read, package, file):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / file).write_bytes(b"anything")
    with pytest.raises(MadocError, match=r'pip install "madoc-calibration\[logs\]"'):
        read(tmp_path / file, ())
