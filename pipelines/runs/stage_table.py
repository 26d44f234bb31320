"""The stages of a run, and what each method makes of them."""

import dataclasses

from pipelines.config.methods import EXTRA_STAGES, METHODS
from pipelines.engine.stage import Stage
from pipelines.stages.certify import CERTIFY
from pipelines.stages.evaluate import EVALUATE
from pipelines.stages.harden import HARDEN
from pipelines.stages.imitate import IMITATE
from pipelines.stages.import_model import IMPORT
from pipelines.stages.leaves import LEAVES
from pipelines.stages.map import MAP
from pipelines.stages.oracle import ORACLE
from pipelines.stages.parse import PARSE
from pipelines.stages.polish import POLISH
from pipelines.stages.prune import PRUNE
from pipelines.stages.simplify import SIMPLIFY
from pipelines.stages.train import TRAIN
from pipelines.stages.video import VIDEO

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        *(TRAIN, IMPORT, ORACLE, MAP, HARDEN, IMITATE, PARSE, PRUNE, EVALUATE),
        *(POLISH, CERTIFY, SIMPLIFY, LEAVES, VIDEO),
    )
}


def stages_of(method: str, *, polished: bool = False) -> dict[str, Stage]:
    """Return a method's stages and the extra ones by name, in order.

    Map reads the actor, trained or imported; prune and evaluate read what was made before. With `polished`, what comes
    after a polish is of the polished policy.
    """
    names = METHODS[method].stages
    before = names[: names.index("prune")]
    actor = METHODS[method].actor_stage
    rows = STAGES | {
        "map": dataclasses.replace(MAP, inputs=(actor,)),
        "prune": dataclasses.replace(PRUNE, inputs=before),
        "evaluate": dataclasses.replace(EVALUATE, inputs=(*before, "prune")),
        "polish": dataclasses.replace(POLISH, inputs=(actor, "prune") if METHODS[method].is_mapped else ("prune",)),
        "certify": dataclasses.replace(CERTIFY, inputs=(actor, "map")),
    }
    if polished:
        after = (CERTIFY, SIMPLIFY, LEAVES, VIDEO)
        rows |= {stage.name: dataclasses.replace(stage, inputs=("polish",)) for stage in after}
    return {name: rows[name] for name in (*names, *EXTRA_STAGES)}
