"""The summary of a finished run: what its stages' reports and manifests say, in one file."""

from pathlib import Path
from typing import Any

from pipelines.config.methods import EXTRA_STAGES
from pipelines.config.run import RunConfig
from pipelines.engine.archive import MANIFEST, read_manifest
from pipelines.engine.stage import Stage, stage_key, stage_status
from pipelines.engine.store import exists, read_csv, read_json
from pipelines.runs.stage_table import stages_of


def summarise(config: RunConfig, run_dir: Path) -> dict[str, Any]:
    """Return a finished run's summary."""
    names = config.method.stages
    made, pruned, evaluated = (
        read_json(run_dir / name / "report.json") for name in (config.method.tree_stage, "prune", "evaluate")
    )
    extras = _extras(config, run_dir)
    manifests = {name: read_manifest(run_dir / name) for name in (*names, *extras)}
    seconds = {name: manifest["seconds"] for name, manifest in manifests.items()}
    if "train" in seconds:
        # The manifest knows the last process alone; a resumed training spent the sum of its segments at least.
        segments_s = sum(float(row["seconds"]) for row in read_csv(run_dir / "train" / "progress.csv"))
        seconds["train"] = round(max(segments_s, seconds["train"]), 3)
    summary = {
        "schema": config.summary_schema,
        "env": config.env.name,
        "task": config.env.task,
        "env_id": config.env.id,
        "method": config.method.name,
        "depth": config.depth,
        "budget": config.budget.name,
        "trainer": config.trainer_name,
        "algorithm": config.algo.name,
        "seed": config.seed,
        "steps": config.train.steps,
        **evaluated["policies"]["tree"],
        "n_leaves": made["n_leaves"],
        "pruned_leaves": pruned["n_leaves"],
        "pruned_depth": pruned["pruned_depth"],
        "patterns": pruned["patterns"],
        "fidelity": evaluated["fidelity"],
        "policies": evaluated["policies"],
        "seconds": seconds,
        "versions": manifests["evaluate"]["versions"],
    }
    if config.changes:
        summary["changes"] = config.changes
    if "imitate" in names:
        summary["oracle"] = {"hidden_widths": list(config.oracle), **evaluated["oracle"]}
        imitated = read_json(run_dir / "imitate" / "report.json")
        summary["imitate"] = {name: imitated[name] for name in ("round", "n_rows", "n_steps")}
    if "n_outside_domain" in evaluated:
        summary |= {name: evaluated[name] for name in ("n_outside_domain", "n_states")}
    if "parse" in names:
        summary["program"] = made["program"]
    if config.imported is not None:
        summary["model"] = config.imported.name
    if not config.is_trained:
        summary |= {"algorithm": "none", "steps": 0}
    reports = {extra: read_json(run_dir / extra / "report.json") for extra in extras}
    if reports.get("polish", {}).get("by") == "critic":
        # What the policy has cost in steps of the environment, its oracle's included; not those that chose candidates
        learnt = sum(reports["polish"][name] for name in ("n_refill_steps", "n_learning_steps"))
        summary["total_steps"] = summary["steps"] + summary.get("imitate", {}).get("n_steps", 0) + learnt
    return summary | reports


def _extras(config: RunConfig, run_dir: Path) -> list[str]:
    """Return the further stages that are done, of the policy or of the polished one; others are of an earlier run."""
    plain, polished = stages_of(config.method.name), stages_of(config.method.name, polished=True)
    done: list[str] = []
    for extra in EXTRA_STAGES:
        stages = [plain[extra], *([polished[extra]] if "polish" in done else [])]
        if any(_is_done(stage, config, run_dir) for stage in stages):
            done.append(extra)
    return done


def _is_done(stage: Stage, config: RunConfig, run_dir: Path) -> bool:
    inputs = {name: run_dir / name for name in stage.inputs}
    if not all(exists(folder / MANIFEST) for folder in (run_dir / stage.name, *inputs.values())):
        return False
    return stage_status(stage, run_dir / stage.name, config, stage_key(stage, config, inputs)) == "done"
