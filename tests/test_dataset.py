"""Data sets: the same bytes whoever makes them, whatever interrupts them, and never mixed."""

from __future__ import annotations

import importlib.util
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from locagen_edge import __version__
from locagen_edge.errors import DatasetError, SettingsError
from locagen_edge.lab.columns import MEANING, columns
from locagen_edge.lab.dataset import Made, complete, make, open_dataset
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.shards import read_metadata, read_shard, shard_path
from locagen_edge.settings import from_table, sample

ROOT = Path(__file__).resolve().parent.parent
SMALL = {"data": {"samples": 500}, "dataset": {"shard": 200}}


def settings_of(level="arrivals", samples=500, shard=200, **sections):
    table = {
        "data": {"samples": samples, **sections.pop("data", {})},
        "dataset": {"level": level, "shard": shard, **sections.pop("dataset", {})},
        "twin": {"noise": "snr", "snr_db": 10.0, **sections.pop("twin", {})},
        **sections,
    }
    return from_table(table, LabSettings)


def shards(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("shard-*.parquet"))}


def command(folder, settings, *more):
    """The command line that makes this data set."""
    file = folder.parent / "lab.toml"
    file.write_text(sample(settings))
    return [
        sys.executable,
        "-m",
        "locagen_edge.lab.cli",
        "dataset",
        str(folder),
        "--settings",
        str(file),
        *more,
    ]


def environment():
    return {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}


def start(arguments, stderr=subprocess.PIPE, **options):
    """In a process group of its own, so that it can be ended with all its workers."""
    return subprocess.Popen(
        arguments, env=environment(), stdout=subprocess.PIPE, stderr=stderr, text=True,
        start_new_session=True, **options,
    )  # fmt: skip


def run(arguments, **options):
    process = start(arguments, **options)
    out, errors = process.communicate(timeout=60)
    return process.returncode, out, errors


def wait_for(what, process, seconds=40.0):
    """Until `what` is true, while `process` lives."""
    end = time.monotonic() + seconds
    while not what():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.01)


# --- what is in it ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "keep"), [("arrivals", []), ("waveforms", []), ("waveforms", ["correlation", "sound", "call"])]
)
def test_a_data_set_holds_what_the_twin_drew(tmp_path, level, keep):
    settings = settings_of(level, dataset={"keep": keep}, scene={"sounds": ["white", "knock"]})
    assert make(tmp_path / "set", settings) == Made(3, 0)
    drawn = columns(settings, 500, settings.data.seed)
    found = open_dataset(tmp_path / "set", settings)
    assert found.samples == 500
    read = found.columns()
    assert list(read) == list(drawn)
    for name, column in drawn.items():
        assert read[name].dtype == column.dtype
        np.testing.assert_array_equal(read[name], column)
    assert set(keep) <= set(read)


def test_every_shard_tells_what_it_is(tmp_path):
    settings = settings_of("waveforms", dataset={"keep": ["sound"]})
    make(tmp_path, settings)
    for number, path in enumerate(sorted(tmp_path.glob("*.parquet"))):
        assert path == shard_path(tmp_path, number)
        told = read_metadata(path)
        assert from_table(tomllib.loads(told["settings"]), LabSettings) == settings
        assert told["version"] == __version__
        assert (told["level"], told["seed"], told["shard"], told["shards"]) == (
            "waveforms",
            "1",
            str(number),
            "3",
        )
        assert (told["first"], told["samples"]) == (str(200 * number), str([200, 200, 100][number]))
        schema = pq.read_schema(path)
        assert set(json.loads(told["sha256"])) == set(schema.names)
        for field in schema:
            assert not field.nullable
            assert field.metadata[b"text"].decode() == MEANING[field.name][1]
            assert field.metadata[b"unit"].decode() == MEANING[field.name][0]
    assert json.loads(schema.field("sound").metadata[b"shape"]) == [3, 1024]
    assert json.loads(schema.field("delay_s").metadata[b"shape"]) == [3]


def test_a_sweep_covers_the_circle_in_tenths_of_a_degree(tmp_path):
    for level in ("arrivals", "waveforms"):
        settings = settings_of(
            level, 3600, 1000, twin={"source": "sweep", "step_deg": 0.1}, audio={"frame": 256, "hop": 128}
        )
        make(tmp_path / level, settings)
        azimuth = open_dataset(tmp_path / level, settings).columns("azimuth_rad")["azimuth_rad"]
        tenths = np.degrees(azimuth.astype(float)) * 10.0 % 3600.0
        assert (np.sort(np.rint(tenths).astype(int) % 3600) == np.arange(3600)).all()


def test_what_is_drawn_does_not_depend_on_the_size_of_shards(tmp_path):
    for shard in (90, 200):
        make(tmp_path / str(shard), settings_of("waveforms", shard=shard))
    asked = settings_of("waveforms")
    small, large = (open_dataset(tmp_path / str(shard), asked).columns() for shard in (90, 200))
    for name, column in small.items():
        np.testing.assert_array_equal(column, large[name])


def test_batches_hold_every_sample_once(tmp_path):
    settings = settings_of()
    make(tmp_path, settings)
    found = open_dataset(tmp_path, settings)
    whole = found.columns("azimuth_rad")["azimuth_rad"]
    in_order = list(found.batches(64, "azimuth_rad"))
    assert [len(b["azimuth_rad"]) for b in in_order] == [64] * 7 + [52]
    np.testing.assert_array_equal(np.concatenate([b["azimuth_rad"] for b in in_order]), whole)
    mixed = [np.concatenate([b["azimuth_rad"] for b in found.batches(64, seed=s)]) for s in (1, 1, 2)]
    np.testing.assert_array_equal(np.sort(mixed[0]), np.sort(whole))
    np.testing.assert_array_equal(mixed[0], mixed[1])
    assert (mixed[0] != mixed[2]).any()


# --- the same bytes, whatever happens ----------------------------------------------------------------------


def test_same_seed_same_bytes_for_one_worker_and_two(tmp_path):
    settings = settings_of("waveforms", scene={"sounds": ["white", "speech"]}, samples=300, shard=70)
    make(tmp_path / "one", settings)
    code, out, errors = run(command(tmp_path / "two", settings, "--workers", "2"))
    assert (code, errors) == (0, "")
    assert "300 samples in 5 shards" in out
    assert shards(tmp_path / "one") == shards(tmp_path / "two")
    other = settings_of(
        "waveforms", scene={"sounds": ["white", "speech"]}, samples=300, shard=70, data={"seed": 2}
    )
    make(tmp_path / "other", other)
    assert not set(shards(tmp_path / "one").values()) & set(shards(tmp_path / "other").values())


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_killed_run_loses_the_shards_in_hand_and_goes_on(tmp_path, workers):
    settings = settings_of("waveforms", samples=6000, shard=300, dataset={"keep": ["correlation"]})
    folder = tmp_path / "set"
    process = start(command(folder, settings, "--workers", workers))
    wait_for(lambda: len(list(folder.glob("shard-*"))) >= 3, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    kept = complete(folder, settings)
    assert 3 <= len(kept) < 20
    for path in folder.glob("shard-*"):
        read_shard(path)  # every hash is right
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("shard-*")}
    (folder / ".shard-00019.parquet.0.part").write_bytes(b"half a file")
    made = make(folder, settings)
    assert made == Made(20, len(before))
    assert {name: (folder / name).stat().st_mtime_ns for name in before} == before
    assert sorted(p.name for p in folder.iterdir()) == [f"shard-{k:05d}.parquet" for k in range(20)]
    if workers == "1":
        make(tmp_path / "whole", settings)
        assert shards(folder) == shards(tmp_path / "whole")


def test_a_worker_that_is_killed_ends_the_run_with_one_line(tmp_path):
    settings = settings_of("waveforms", samples=20_000, shard=200)
    folder = tmp_path / "set"
    process = start(command(folder, settings, "--workers", "2"))
    wait_for(lambda: len(list(folder.glob("shard-*"))) >= 2, process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    if not children.exists():
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        pytest.skip("this kernel does not tell who the workers are")
    workers = [
        pid
        for pid in map(int, children.read_text().split())
        if b"resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    os.kill(workers[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert len(errors.splitlines()) == 1, errors
    assert "ended from outside" in errors
    assert complete(folder, settings)


def test_an_interrupted_run_says_so_in_one_line(tmp_path):
    settings = settings_of("waveforms", samples=20_000, shard=200)
    process = start(command(tmp_path / "set", settings))
    wait_for(lambda: len(list((tmp_path / "set").glob("shard-*"))) >= 1, process)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert len(errors.splitlines()) == 1
    assert errors.startswith("interrupted")
    assert not list((tmp_path / "set").glob(".*"))


def small_disk(folder):
    """A file system of 200 KiB at `folder`, or None where nobody may mount one."""
    if shutil.which("mount") is None:
        return None
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(folder)], check=False, capture_output=True
    )
    return folder if done.returncode == 0 else None


def test_a_full_disk_ends_with_one_line_and_goes_on_when_there_is_room(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if small_disk(disk) is None:
        pytest.skip("no right to mount a small file system; the next test does it with a limit on files")
    settings = settings_of("arrivals", samples=20_000, shard=4000)
    try:
        for workers in ("1", "2"):
            code, out, errors = run(command(disk / "set", settings, "--workers", workers))
            assert (code, out, len(errors.splitlines())) == (1, "", 1), errors
            assert "the disk is full" in errors
        there = shards(disk / "set")
        assert 0 < len(there) < 5
        assert complete(disk / "set", settings) == {int(name[6:11]) for name in there}
        assert not list((disk / "set").glob(".*"))
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        assert make(disk / "set", settings) == Made(5, len(there))
        assert there.items() <= shards(disk / "set").items()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_limit_on_files_ends_the_same_way(tmp_path):
    settings = settings_of("arrivals", samples=9000, shard=4000)  # the last shard is a small one

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    code, _, errors = run(command(tmp_path / "set", settings), preexec_fn=limit)
    assert code == 1
    assert len(errors.splitlines()) == 1
    assert "the disk is full" in errors
    assert list((tmp_path / "set").iterdir()) == []


@pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="dask.distributed is not installed"
)
def test_a_cluster_that_loses_a_worker_loses_and_doubles_nothing(tmp_path):
    settings = settings_of("waveforms", samples=9000, shard=300, dataset={"keep": ["correlation"]})
    contact = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = ["--no-dashboard", "--scheduler-file", str(contact)]
    worker = [
        *dask, "worker", *quiet, "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1",
        "--memory-limit", "0", "--local-directory", str(tmp_path / "scratch"),
    ]  # fmt: skip
    processes = [start([*dask, "scheduler", *quiet, "--host", "127.0.0.1", "--port", "0"])]
    try:
        wait_for(contact.exists, processes[0])
        for name in ("steady", "doomed"):
            log = tmp_path / name
            with log.open("w") as file:
                processes.append(start([*worker, "--name", name], stderr=file))
            wait_for(lambda log=log: "Registered to" in log.read_text(), processes[-1])
        folder = tmp_path / "set"
        address = json.loads(contact.read_text())["address"]
        client = start(command(folder, settings, "--scheduler", address))
        processes.append(client)
        wait_for(lambda: len(list(folder.glob("shard-*"))) >= 6, client)
        os.killpg(processes[2].pid, signal.SIGKILL)
        assert len(list(folder.glob("shard-*"))) < 30
        out, errors = client.communicate(timeout=60)
        assert client.returncode == 0, errors
        assert "9000 samples in 30 shards" in out
        assert processes[1].poll() is None
    finally:
        for process in processes[::-1]:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    assert not list(folder.glob(".*"))
    make(tmp_path / "here", settings)
    assert shards(folder) == shards(tmp_path / "here")


@pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="dask.distributed is not installed"
)
def test_a_scheduler_that_is_not_there_is_told_in_one_line(tmp_path):
    environment_of = {**environment(), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "300ms"}
    done = subprocess.run(
        command(tmp_path / "set", settings_of(), "--scheduler", "tcp://127.0.0.1:9"),
        env=environment_of, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "tcp://127.0.0.1:9" in done.stderr


# --- what is refused ---------------------------------------------------------------------------------------


def test_a_folder_of_other_settings_is_refused_by_the_names_of_all_keys(tmp_path):
    make(tmp_path, settings_of())
    other = settings_of(twin={"range_m": 50.0}, audio={"rate_hz": 48000}, data={"seed": 3}, shard=100)
    before = shards(tmp_path)
    with pytest.raises(DatasetError) as caught:
        make(tmp_path, other)
    told = str(caught.value).splitlines()[1:]
    assert {line.partition(":")[0] for line in told} == {
        "twin.range_m", "audio.rate_hz", "data.seed", "dataset.shard"
    }  # fmt: skip
    assert "twin.range_m: 100.0 there, 50.0 asked for" in told
    assert shards(tmp_path) == before


def test_a_model_gets_only_data_of_the_settings_it_asks_for(tmp_path):
    make(tmp_path, settings_of())
    for key, other in {
        "twin.snr_db": settings_of(twin={"snr_db": 11.0}),
        "environment.temperature_c": settings_of(environment={"temperature_c": 0.0}),
        "dataset.level": settings_of("waveforms"),
        "array.positions_m": settings_of(array={"positions_m": [[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]}),
    }.items():
        with pytest.raises(DatasetError, match=f"(?m)^{key}: "):
            open_dataset(tmp_path, other)
    # what makes no difference to the samples may differ
    same = settings_of(samples=10_000, shard=7, data={"seed": 9}, mlp={"width": 8}, scene={"ground": 0.5})
    assert open_dataset(tmp_path, same).samples == 500


def test_an_unfinished_set_is_not_opened(tmp_path):
    settings = settings_of()
    with pytest.raises(DatasetError, match="holds no data set"):
        open_dataset(tmp_path, settings)
    make(tmp_path, settings)
    shard_path(tmp_path, 1).unlink()
    with pytest.raises(DatasetError, match=r"1 of 3 shards are missing, 1 the first"):
        open_dataset(tmp_path, settings)


def test_shards_of_two_sets_are_not_mixed(tmp_path):
    make(tmp_path / "a", settings_of())
    make(tmp_path / "b", settings_of(data={"seed": 2}))
    shard_path(tmp_path / "b", 1).replace(shard_path(tmp_path / "a", 1))
    with pytest.raises(DatasetError, match="two data sets"):
        open_dataset(tmp_path / "a", settings_of())
    with pytest.raises(DatasetError, match=r"(?m)^data\.seed: 2 there, 1 asked for"):
        make(tmp_path / "a", settings_of())


def test_other_recordings_under_the_same_name_are_another_set(tmp_path):
    import soundfile

    sounds = tmp_path / "sounds"
    sounds.mkdir()
    for k in range(2):
        soundfile.write(sounds / f"{k}.wav", 0.1 * np.random.default_rng(k).standard_normal(3000), 16000)
    settings = settings_of("waveforms", 150, 100, scene={"sounds": ["recorded"], "recordings": str(sounds)})
    make(tmp_path / "set", settings)
    make(tmp_path / "set", settings)
    (sounds / "1.wav").unlink()
    code, _, errors = run(command(tmp_path / "set", settings))
    assert code == 1
    assert "scene.recordings: other files" in errors


def test_damage_is_noticed(tmp_path):
    make(tmp_path, settings_of())
    path = shard_path(tmp_path, 0)
    content = bytearray(path.read_bytes())
    content[400] ^= 0x10  # amid the first column
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="damaged"):
        open_dataset(tmp_path, settings_of()).columns()
    path.write_bytes(content[:300])
    for call in (make, open_dataset):
        with pytest.raises(DatasetError, match="not a readable shard"):
            call(tmp_path, settings_of())


def test_columns_that_are_not_there_are_named(tmp_path):
    make(tmp_path, settings_of())
    with pytest.raises(DatasetError, match="no column sound; it has delay_s"):
        open_dataset(tmp_path, settings_of()).columns("delay_s", "sound")


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    settings = settings_of("waveforms", samples=20_000, shard=200)
    process = start(command(tmp_path / "set", settings))
    try:
        wait_for(lambda: list((tmp_path / "set").glob("shard-*")), process)
        with pytest.raises(DatasetError, match="another run"):
            make(tmp_path / "set", settings)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_impossible_parameters_are_refused_all_at_once(tmp_path):
    code, _, errors = run([
        sys.executable, "-m", "locagen_edge.lab.cli", "dataset", str(tmp_path / "set"),
        "--samples", "0", "--shard-size", "-5", "--level", "dreams",
    ])  # fmt: skip
    assert code == 1
    assert {line.split(": ")[1] for line in errors.splitlines()} == {
        "data.samples", "dataset.shard", "dataset.level"
    }  # fmt: skip
    assert not (tmp_path / "set").exists()
    with pytest.raises(SettingsError):
        settings_of(shard=0)
