"""`wheelset sql` on a terminal: a prompt with history, completion of views, columns and keywords, and dot commands.

Every statement goes through the same read-only gate as `wheelset sql "…"`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.ask import FORMATS, ask, open_read_only
from pipelines.options import did_you_mean
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from prompt_toolkit.completion import Completer

HELP = """.tables           views, with what they hold
.schema VIEW      columns of a view, with type and meaning
.report NAME      a report's queries, by the views that hold their answers
.format NAME      table, csv or json, for what follows
.read FILE        run the query in a file
.set NAME VALUE   a filter of the reports' views: since, until, rig_id, wheelset_id; without VALUE none
.quit             leave (or Ctrl-D)
A query ends with a semicolon and may run over several lines."""
COMMANDS = (".tables", ".schema", ".report", ".format", ".read", ".set", ".help", ".quit")
KEYWORDS = re.findall(
    r"\w+",
    """SELECT FROM WHERE GROUP BY ORDER LIMIT JOIN LEFT USING ON AS AND OR NOT NULL IS IN LIKE BETWEEN CASE WHEN THEN ELSE END
    WITH DISTINCT HAVING QUALIFY OVER PARTITION DESC ASC UNION ALL DESCRIBE SUMMARIZE count avg min max stddev_samp
    arg_max arg_min date_trunc regr_slope quantile_cont""",
)
VARIABLES = ("since", "until", "rig_id", "wheelset_id", "scan_id", "version_a", "version_b")


class Shell:
    """One session: what a line does. Reading lines is `interactive`'s work, so that tests can feed it."""

    def __init__(self, root: Path, write: Callable[[str], None] = print) -> None:
        self.root, self.write = root, write
        self.format = "table"
        self.pending = ""
        self.variables: dict[str, str] = {}
        connection = open_read_only(root)
        try:
            self.columns: dict[str, list[tuple[str, str, str]]] = {}
            for view, column, kind, comment in connection.execute(
                "SELECT table_name, column_name, data_type, comment FROM duckdb_columns() WHERE NOT internal"
                " ORDER BY table_name, column_index"
            ).fetchall():
                self.columns.setdefault(view, []).append((column, kind, comment or ""))
            self.meanings = dict(
                connection.execute("SELECT view_name, comment FROM duckdb_views() WHERE NOT internal").fetchall()
            )
        finally:
            connection.close()

    def line(self, text: str) -> bool:
        """Take one line; False when the session ends. Errors are told, not raised."""
        if not self.pending and not text.strip():
            return True
        if not self.pending and text.lstrip().startswith("."):
            try:
                return self.command(text.split())
            except ConfigError as error:
                self.write(str(error))
                return True
        self.pending += text + "\n"
        if text.rstrip().endswith(";"):
            query, self.pending = self.pending.strip(), ""
            self.run(query)
        return True

    def run(self, query: str) -> None:
        """Answer one query in the session's format."""
        try:
            ask(self.root, query, self.format, None, self.variables)
            sys.stdout.flush()
        except ConfigError as error:
            self.write(str(error))

    def command(self, words: list[str]) -> bool:
        """Do what a line that begins with a dot says; False for the end of the session, ConfigError if it is wrong."""
        name, given = words[0], words[1:]
        if name in (".quit", ".exit", ".q"):
            return False
        if name == ".tables":
            width = max(map(len, self.columns), default=0)
            for view in sorted(self.columns):
                self.write(f"{view:<{width}}  {(self.meanings.get(view) or '').split('. ')[0]}")
        elif name == ".schema":
            self._schema(given[0] if given else None)
        elif name == ".report":
            self._report(given[0] if given else None)
        elif name == ".format":
            if len(given) != 1 or given[0] not in FORMATS or given[0] == "parquet":
                raise ConfigError(".format: expected table, csv or json")
            self.format = given[0]
        elif name == ".set":
            if not given or given[0] not in VARIABLES:
                raise ConfigError(f".set: expected one of {', '.join(VARIABLES)}, and a value")
            self.variables.pop(given[0], None)
            if len(given) > 1:
                self.variables[given[0]] = " ".join(given[1:])
        elif name == ".read":
            self.run(read_query(Path(" ".join(given))))
        else:
            self.write(HELP)
        return True

    def _schema(self, view: str | None) -> None:
        if view not in self.columns:
            hint = did_you_mean(view or "", self.columns)
            raise ConfigError(f".schema: expected a view that .tables lists; found {view or 'none'}{hint}")
        width = max(len(column) for column, _, _ in self.columns[view])
        kinds = max(len(kind) for _, kind, _ in self.columns[view])
        for column, kind, meaning in self.columns[view]:
            self.write(f"{column:<{width}}  {kind:<{kinds}}  {meaning}")

    def _report(self, name: str | None) -> None:
        from warehouse.report import REPORTS

        if name not in REPORTS:
            raise ConfigError(f".report: expected one of {', '.join(REPORTS)}")
        for block in REPORTS[name].blocks:
            self.write(f"{REPORTS[name].view(block):<28} {block.title}  [{block.sql}]")

    def words(self, line: str) -> Iterable[str]:
        """What may stand at the end of this line."""
        if line.lstrip().startswith("."):
            command, _, rest = line.lstrip().partition(" ")
            if not rest and not line.endswith(" "):
                return COMMANDS
            from warehouse.report import REPORTS

            choices: dict[str, Iterable[str]] = {
                ".schema": self.columns,
                ".format": ("table", "csv", "json"),
                ".set": VARIABLES,
                ".report": REPORTS,
            }
            return choices.get(command, ())
        text = self.pending + line
        named = [view for view in self.columns if view in text.replace(",", " ").split()]
        columns = {column for view in named or self.columns for column, _, _ in self.columns[view]}
        return [*sorted(columns), *sorted(self.columns), *KEYWORDS]


def read_query(file: Path) -> str:
    """The query in a file."""
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--file {file}: cannot be read: {error}") from error


def interactive(root: Path) -> int:
    """Prompt until the reader leaves; the history is kept beside the user's other state."""
    from prompt_toolkit import PromptSession
    from prompt_toolkit.history import FileHistory

    shell = Shell(root)
    history = Path.home() / ".wheelset_history"
    session: PromptSession[str] = PromptSession(history=FileHistory(str(history)), completer=_completer(shell))
    print(f"{root}: read-only. .help for help; a query ends with a semicolon.")
    while True:
        try:
            text = session.prompt("      ...> " if shell.pending else "wheelset> ")
        except KeyboardInterrupt:
            shell.pending = ""
            continue
        except EOFError:
            return 0
        if not shell.line(text):
            return 0


def _completer(shell: Shell) -> Completer:
    from prompt_toolkit.completion import Completer, Completion

    class Words(Completer):
        def get_completions(self, document: Any, complete_event: Any) -> Iterable[Completion]:
            line = document.text_before_cursor
            start = document.get_word_before_cursor(WORD=line.lstrip().startswith("."))
            for word in shell.words(line):
                if start and word.lower().startswith(start.lower()):
                    yield Completion(word, start_position=-len(start))

    return Words()
