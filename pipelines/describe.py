"""The data dictionary for people and scripts, derived from the declarations: nothing is written down twice here."""

from __future__ import annotations

from typing import Any

from warehouse.catalog import DERIVED
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError, Flag
from wheelset_assets.quantities import QUANTITIES
from wheelset_assets.stages import CONFIG_SECTIONS, STAGES
from wheelset_assets.tables import ALL_TABLES

TOPICS = ("tables", "quantities", "config", "flags", "stages")


def describe(what: str | None, config: Config) -> dict[str, Any]:
    """One topic, one table, or an overview of all."""
    tables = {t.name: t for t in (*ALL_TABLES, *DERIVED)}
    if what in tables:
        table = tables[what]
        columns = [
            {"column": c.name, "type": c.type, "unit": c.unit, "meaning": c.meaning, "nullable": c.nullable}
            for c in table.columns
        ]
        return {
            "table": table.name,
            "meaning": table.meaning,
            "version": table.version,
            "key": list(table.key),
            "columns": columns,
        }
    topics = {
        "tables": lambda: [{"table": t.name, "meaning": t.meaning, "layout": t.layout} for t in tables.values()],
        "quantities": lambda: [
            {
                "quantity": q.name,
                "sides": ", ".join(q.sides),
                "unit": q.unit,
                "definition": q.definition,
                "parameters": ", ".join(f"{name}={getattr(config.measurement, name)}" for name in q.parameters),
                "support": q.support,
                "zero": q.kind,
                "source": q.source,
            }
            for q in QUANTITIES
        ],
        "config": lambda: _knobs(config),
        "flags": lambda: [{"flag": f.name.lower(), "bit": int(f)} for f in Flag if f and f.name],
        "stages": lambda: [
            {
                "stage": s.name,
                "version": s.code_version,
                "meaning": s.meaning,
                "inputs": [*s.inputs, *s.raw_inputs],
                "outputs": [t.name for t in s.outputs],
            }
            for s in STAGES
        ],
    }
    if what is None:
        return {"topics": list(TOPICS), **{name: topics[name]() for name in ("stages", "tables", "quantities")}}
    if what not in topics:
        raise ConfigError(f"describe {what!r}: expected {', '.join(TOPICS)}, or a table: {', '.join(tables)}")
    return {what: topics[what]()}


def _knobs(config: Config) -> list[dict[str, Any]]:
    rows = []
    for section in CONFIG_SECTIONS.values():
        model = getattr(config, section)
        for name, info in type(model).model_fields.items():
            rows.append(
                {
                    "key": f"{section}.{name}",
                    "value": getattr(model, name),
                    "default": info.default,
                    "meaning": info.description,
                }
            )
    return rows
