"""Packed runs: the same files under the same names, what is left out made again, and damage always told."""

import dataclasses
import multiprocessing
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipelines.cli.pack import pack_results
from pipelines.cli.runs import load_config
from pipelines.engine.archive import file_digest, is_whole, opened, pack, read_manifest, verified_manifest
from pipelines.engine.digests import digest
from pipelines.engine.stage import Stage, _twin, run_stage
from pipelines.engine.store import ARCHIVE, CONFIG, archive_files, exists, read_bytes, write_json
from pipelines.errors import PipelineError
from pipelines.play.actor_files import load_actor
from pipelines.runs.derived import derive, opened_run
from pipelines.runs.finished_run import tree_of
from pipelines.training.critics import CRITICS, load_critics
from tests.committed import copy_run

PENDULUM = "pendulum/otr/depth-6/quick/seed-0"
WIDE = "pendulum/otr/depth-32/quick/seed-0"
VIPER = "pendulum/viper/depth-6/quick/seed-0"
WALKER = "walker2d/otr/depth-32/standard-ars/seed-5"


def files_of(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def pack_run(run_dir):
    pack(run_dir, partial(derive, load_config(run_dir, None)))


@pytest.fixture
def run(tmp_path):
    copy_run(PENDULUM, tmp_path / "runs" / PENDULUM)
    return tmp_path / "runs" / PENDULUM


@pytest.fixture
def packed(run):
    pack_run(run)
    return run


def test_a_packed_run_opens_with_every_file_that_it_had(run):
    before = files_of(run)
    pack_run(run)
    assert sorted(path.name for path in run.iterdir()) == [ARCHIVE, "summary.json"]
    left_out = {name for name in set(before) - set(archive_files(run)) if "/" in name}
    assert left_out == {f"map/{name}" for name in ("program.txt", "tree.json", "tree.npz")} | {
        name for name in before if name.endswith("/program.txt")}  # fmt: skip
    with opened_run(load_config(run, None), run) as whole:
        assert whole != run and files_of(whole) == before
        for stage in ("train", "map", "prune", "evaluate"):
            verified_manifest(whole / stage)
    assert not whole.exists()


def test_the_same_run_gives_the_same_archive_and_new_stages_join_it(run, tmp_path):
    shutil.copytree(run, tmp_path / "copy")
    shutil.move(run / "prune", tmp_path / "prune")
    pack_run(run)
    assert not exists(run / "prune/manifest.json")
    shutil.move(tmp_path / "prune", run / "prune")
    pack_run(run)
    pack_run(tmp_path / "copy")
    assert (run / ARCHIVE).read_bytes() == (tmp_path / "copy" / ARCHIVE).read_bytes()
    pack_run(run)  # nothing is left to pack
    assert (run / ARCHIVE).read_bytes() == (tmp_path / "copy" / ARCHIVE).read_bytes()


def test_all_runs_of_a_folder_are_packed_but_those_that_were_changed(run, tmp_path, capsys):
    changed = tmp_path / "runs" / PENDULUM.replace("seed-0", "seed-1")
    shutil.copytree(run, changed)
    with (changed / "evaluate" / "episodes.csv").open("a") as file:
        file.write("1,2,3\n")
    before = files_of(changed)
    assert pack_results(tmp_path) == 1
    assert (run / ARCHIVE).is_file()
    assert files_of(changed) == before
    out, err = capsys.readouterr()
    assert "packed: 1; left as they are: 1" in out
    assert f"{changed} stays as it is: {changed / 'evaluate' / 'episodes.csv'} is not what was written" in err
    assert pack_results(tmp_path / "elsewhere") == 1
    assert f"{tmp_path / 'elsewhere' / 'runs'}: there is no such folder" in capsys.readouterr().err


def test_the_pruned_tree_of_a_wide_network_is_kept_as_its_paths(command, tmp_path):
    run = tmp_path / "runs" / WIDE
    copy_run(WIDE, run, "prune", "evaluate")
    words = ("env=pendulum", "depth=32", "budget=quick", f"results_dir={tmp_path}", "n_workers=1")
    assert command("run", *words, "stages=[prune]").returncode == 0
    before = files_of(run / "prune")
    pack_run(run)
    assert {"prune/tree.npz", "prune/tree.json"}.isdisjoint(archive_files(run)) and "tree.npz" in before
    with opened_run(load_config(run, None), run) as whole:
        assert files_of(whole / "prune") == {name: before[name] for name in before if name != "tree.svg"}


def test_what_is_made_again_otherwise_is_refused(packed):
    config = load_config(packed, None)

    def other_printer(run_dir, folder):
        return derive(config, run_dir, folder) | {"program.txt": b"if\n"}

    with (
        pytest.raises(PipelineError, match=r"prune/program.txt is left out of .* another sha256 .*\n.*'numpy'"),
        opened(packed, ["prune"], other_printer),
    ):
        pass
    with pytest.raises(PipelineError, match="cannot be made again"), opened(packed, ["map"], lambda *_: {}):
        pass


def test_trees_that_another_processor_rounds_otherwise_are_said_and_used(packed, capsys):
    config, recorded = load_config(packed, None), read_manifest(packed / "map")

    def other_processor(run_dir, folder):
        made = derive(config, run_dir, folder)
        return {name: content + b" " * name.startswith("tree.") for name, content in made.items()}

    with opened(packed, ["map"], other_processor) as whole:
        assert "map: tree.json, tree.npz, made again" in capsys.readouterr().err
        assert verified_manifest(whole / "map")["output_digest"] != recorded["output_digest"]
    assert read_manifest(packed / "map") == recorded


OPEN = """
import shutil, sys
from pathlib import Path
from pipelines.cli.pack import pack_results
from pipelines.cli.runs import load_config
from pipelines.runs.derived import opened_run

run = Path(sys.argv[1])
with opened_run(load_config(run, None), run) as whole:
    shutil.copy(whole / "prune/tree.npz", sys.argv[2])
"""


def test_a_wide_run_opens_under_other_kernels_and_differs_in_the_last_bit(tmp_path):
    """OpenBLAS chooses its kernels by the processor, or by OPENBLAS_CORETYPE."""
    run, trees = Path(__file__).parents[3] / "results/runs" / WALKER, []
    for kernels in ("Haswell", "Prescott"):
        out = tmp_path / f"{kernels}.npz"
        environment = os.environ | {"OPENBLAS_CORETYPE": kernels}
        done = subprocess.run([sys.executable, "-c", OPEN, run, out], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        trees.append(np.load(out))
    for name in trees[0].files:
        one, other = (tree[name] for tree in trees)
        assert np.abs(one - other).max() <= 1e-14 * np.abs(one).max()


def test_what_cannot_be_made_again_is_kept_and_new_stages_join_an_archive_of_other_rounding(run):
    config, before = load_config(run, None), files_of(run)
    shutil.move(run / "evaluate", run.parent / "evaluate")
    pack(run, lambda run_dir, folder: derive(config, run_dir, folder) | {"program.txt": b"if\n"})
    first = archive_files(run)
    assert first["prune/program.txt"] == before["prune/program.txt"] and "map/tree.npz" not in first
    shutil.move(run.parent / "evaluate", run / "evaluate")
    pack(run, lambda *_: {"tree.npz": b"other", "tree.json": b"other"})
    after = archive_files(run)
    assert first.items() <= after.items() and "evaluate/manifest.json" in after


def test_a_damaged_archive_is_named_with_the_way_out(packed):
    whole = (packed / ARCHIVE).read_bytes()
    for i in (int(place * len(whole)) for place in (0, 0.01, 0.5, 0.9999)):
        for rest in (b"", bytes([whole[i] ^ 255]) + whole[i + 1 :]):
            (packed / ARCHIVE).write_bytes(whole[:i] + rest)
            message = rf"{ARCHIVE} cannot be read: .*\nRestore it, or delete the folder {packed}"
            with pytest.raises(PipelineError, match=message):
                read_manifest(packed / "evaluate")


def test_a_packed_run_gets_a_certificate_and_another_run_shares_its_stages(run, tmp_path, command):
    for extra in ("certify", "simplify"):
        shutil.rmtree(run / extra, ignore_errors=True)
    pack_run(run)
    words = ("env=pendulum", "depth=6", "budget=quick", f"results_dir={tmp_path}", "n_workers=1")
    assert command("run", *words, "certify=true").returncode == 0
    assert [path.name for path in run.iterdir() if path.is_dir()] == ["certify"]
    assert command("verify", f"run={run}").stdout.startswith("verified: 30 leaves")
    pack_run(run)
    assert command("verify", f"run={run}").stdout.startswith("verified: 30 leaves")
    done = command("run", *words, "evaluate.n_episodes=2")
    (other,) = run.parent.glob("seed-0~*")
    assert done.returncode == 0 and "train: done before" in done.stdout
    for stage in ("train", "map", "prune"):
        assert read_manifest(other / stage)["key"] == verified_manifest(run / stage)["key"]
        verified_manifest(other / stage)


def open_and_hash(run_dir, queue):
    with opened_run(load_config(run_dir, None), run_dir) as whole:
        queue.put({path.relative_to(whole).as_posix(): file_digest(path) for path in whole.glob("*/*")})


def test_processes_open_a_run_at_once(packed):
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    workers = [context.Process(target=open_and_hash, args=(packed, queue)) for _ in range(2)]
    for worker in workers:
        worker.start()
    first, second = queue.get(timeout=60), queue.get(timeout=60)
    for worker in workers:
        worker.join()
    assert first == second and first["map/tree.npz"] == read_manifest(packed / "map")["outputs"]["tree.npz"]


def test_critics_are_not_packed_and_nobody_misses_them_but_who_asks_for_them(run):
    manifest, critics = read_manifest(run / "train"), run / "train" / CRITICS
    critics.write_bytes(b"values")
    outputs = manifest["outputs"] | {CRITICS: file_digest(critics)}
    write_json(run / "train/manifest.json", manifest | {"outputs": outputs, "output_digest": digest(outputs)})
    critics.write_bytes(b"other values")
    for refused in (lambda: verified_manifest(run / "train"), lambda: pack_run(run)):
        with pytest.raises(PipelineError, match="is not what was written"):
            refused()
    assert (run / "train").is_dir() and not (run / ARCHIVE).exists()
    critics.write_bytes(b"values")
    verified_manifest(run / "train")
    pack_run(run)
    assert f"train/{CRITICS}" not in archive_files(run)
    assert verified_manifest(run / "train")["outputs"] == outputs
    with opened_run(load_config(run, None), run) as whole:
        assert verified_manifest(whole / "train")["outputs"] == outputs  # a run that shares the stage copies it so
        load_actor(whole / "train")
    with pytest.raises(PipelineError, match=r"critics\.safetensors is not there.*\n.*results_dir=DIR, another folder"):
        load_critics(run / "train")


def test_large_trees_of_imitations_and_this_machine_s_folder_are_not_packed(tmp_path, monkeypatch):
    run = tmp_path / "runs" / VIPER
    copy_run(VIPER, run)
    text = (run / CONFIG).read_text()
    (run / CONFIG).write_text(text.replace("results_dir: results\n", "results_dir: /elsewhere/results\n"))
    monkeypatch.setattr("pipelines.engine.archive.LARGE_BYTES", 10)
    assert is_whole(run / "imitate")
    pack_run(run)
    assert not (run / CONFIG).exists() and read_bytes(run / CONFIG).decode() == text
    assert "imitate/tree.npz" not in archive_files(run) and not is_whole(run / "imitate")
    config = load_config(run, None)
    assert tree_of("pruned", config, run).n_leaves > 1
    with pytest.raises(PipelineError, match=r"packed without its tree.*\n.*results_dir=DIR"):
        tree_of("full", config, run)
    after = Stage("after", 1, ("imitate",), keyed=lambda config: {}, run=lambda *_: pytest.fail("it has no tree"))
    with pytest.raises(PipelineError, match="packed without its tree"):
        run_stage(after, run, dataclasses.replace(config, results_dir=str(tmp_path)), "")
    assert _twin(run.with_name("seed-9"), "imitate", read_manifest(run / "imitate")["key"]) is None
    assert _twin(run.with_name("seed-9"), "prune", read_manifest(run / "prune")["key"]) == run / "prune"
