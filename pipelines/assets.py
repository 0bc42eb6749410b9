"""Dagster assets, generated from the stage declarations: one an asset, its table's columns as metadata.

No annotations are postponed here: Dagster inspects them.
"""

from typing import Any

import dagster as dg

from warehouse.events import event
from warehouse.facts import StageFacts, stage_facts
from warehouse.lineage import CALIBRATION_DAY, FLEET_DAY
from warehouse.night import Night
from warehouse.summary import StageSummary
from wheelset_assets.config import Config
from wheelset_assets.declare import Stage, Table
from wheelset_assets.stages import CALIBRATION, CONFIG_SECTIONS, REPEATABILITY, SCAN_STAGES, STAGES

DAYS_NAME = "acquisition_day"
DAYS = dg.DynamicPartitionsDefinition(name=DAYS_NAME)
"""Acquisition days with scans, added as the inbox shows them: also days that lie in the future."""
MOST_REASONS = 20
_ASSET_OF = {table.name: stage.name for stage in STAGES for table in stage.outputs}


def column_schema(table: Table) -> dg.TableSchema:
    """The declared columns as Dagster shows them."""
    return dg.TableSchema(columns=[dg.TableColumn(c.name, c.type, description=c.comment) for c in table.columns])


def _metadata(stage: Stage, summary: StageSummary, facts: StageFacts) -> dict[str, Any]:
    """Figures of the partition as it stands, so that a plot over time does not drop where a run had nothing to do; then
    what this run did. Numbers by kind have keys of their own: Dagster plots every number."""
    reasons = "\n".join(
        f"| {count} | {str(reason).replace('|', '/')} |" for reason, count in summary.reasons.most_common()
    )
    return {
        "rows": facts.rows,
        **({"points": facts.points} if stage is SCAN_STAGES[0] else {}),
        "seconds": round(facts.seconds, 3),
        "bytes": facts.bytes,
        "units": facts.units,
        "refused": facts.refused,
        "failed": facts.failed,
        **{f"flag: {name}": count for name, count in sorted(facts.flags.items())},
        **{f"failures: {kind}": count for kind, count in facts.reasons.most_common(MOST_REASONS)},
        "computed": summary.computed,
        "unchanged": summary.unchanged,
        "blocked": summary.blocked,
        "reasons": dg.MetadataValue.md(f"| scans | reason |\n|---|---|\n{reasons}" if reasons else "none"),
    }


def _result(night: Night, stage: Stage, day: str, summary: StageSummary) -> dg.MaterializeResult:
    facts = stage_facts(night.root, night.ledger, day, stage)
    event(
        "stage finished",
        run_id=night.run_id,
        day=day,
        stage=stage.name,
        computed=summary.computed,
        unchanged=summary.unchanged,
        refused=summary.refused,
        failed=summary.failed,
        blocked=summary.blocked,
        seconds=round(summary.seconds, 3),
        points=summary.points,
        flags={name: count for name, count in facts.flags.items() if count},
    )
    bad = summary.refused + summary.failed
    check = dg.AssetCheckResult(
        check_name="no_failed_scans",
        passed=bad == 0,
        severity=dg.AssetCheckSeverity.WARN,
        metadata={"refused": summary.refused, "failed": summary.failed},
    )
    return dg.MaterializeResult(
        data_version=dg.DataVersion(summary.data_version),
        metadata=_metadata(stage, summary, facts),
        check_results=[check],
    )


def build_asset(stage: Stage, config: Config) -> dg.AssetsDefinition:
    """The asset of a stage; its body asks the night to run the stage."""
    partitions = DAYS if stage.scope == "scan" else None
    others = list(stage.outputs[1:])
    description = stage.meaning + ".\n\n" + stage.outputs[0].meaning + "."
    if others:
        description += "\n\nAlso writes " + "; ".join(f"`{t.name}`: {t.meaning.lower()}" for t in others) + "."
    deps = dict.fromkeys(_ASSET_OF[name] for name in stage.inputs if _ASSET_OF[name] != stage.name)
    section = getattr(config, CONFIG_SECTIONS[stage.name])

    @dg.asset(
        name=stage.name,
        deps=[dg.AssetKey(name) for name in deps],
        partitions_def=partitions,
        description=description,
        group_name="wheelset",
        code_version=f"{stage.code_version}+{section.fingerprint()}",
        required_resource_keys={"night"},
        kinds={"parquet"},
        metadata={
            "dagster/column_schema": column_schema(stage.outputs[0]),
            "tables": ", ".join(t.name for t in stage.outputs),
        },
        check_specs=[
            dg.AssetCheckSpec(
                "no_failed_scans",
                asset=dg.AssetKey(stage.name),
                description="No scan was refused or failed in this run",
            )
        ],
    )
    def made(context):
        night: Night = context.resources.night
        try:
            if stage is CALIBRATION:
                return _result(night, stage, CALIBRATION_DAY, night.run_calibrations())
            if stage is REPEATABILITY:
                return _result(night, stage, FLEET_DAY, night.run_fleet())
            day = context.partition_key
            return _result(night, stage, day, night.run_stage(stage, day))
        except BaseException as error:
            night.error = error
            raise

    return made


def build_assets(config: Config) -> list[dg.AssetsDefinition]:
    """All eight assets in order."""
    return [build_asset(stage, config) for stage in (CALIBRATION, *SCAN_STAGES, REPEATABILITY)]
