"""The models that a server serves: every version of every model of its folders, loaded, checked, replaced whole.

A version is checked before it answers: checksum, metadata, shapes, and the golden vectors, which are computed again. A
version that fails is refused with the reason, and the others go on serving. To load a model again reads its files into
new sessions and then changes one reference: a request that has begun finishes with its version, and a version whose new
files are refused goes on with the old ones.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from isocharge.common.errors import ModelError, ModelNotFound
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import Model, check_golden, load_model
from isocharge.serve.model.repository import model_names, repositories, version_folders
from isocharge.serve.network.statistics import Statistics
from isocharge.serve.prediction.bound_press import BoundPress
from isocharge.serve.prediction.validity import Validity

log = logging.getLogger(__name__)

UNLOADED = "unloaded"
"""The reason that the index gives for a model that a client unloaded."""


@dataclass(frozen=True)
class LoadedVersion:
    """One version of a model that answers requests."""

    model: Model
    metadata: ModelMetadata
    version: str
    statistics: Statistics = field(default_factory=Statistics)
    _of_thread: threading.local = field(default_factory=threading.local, repr=False)

    @cached_property
    def misfit_limit(self) -> float:
        """Misfit above which a press has the flag `misfit`, in standard deviations."""
        return Validity.of(self.metadata).misfit_limit

    def press(self) -> BoundPress:
        """Bound memory for one press; each thread has its own."""
        try:
            return self._of_thread.press  # type: ignore[no-any-return]
        except AttributeError:
            self._of_thread.press = BoundPress(self.model.session, len(self.metadata.electrodes))
            return self._of_thread.press  # type: ignore[no-any-return]


@dataclass(frozen=True)
class ModelVersions:
    """The versions of one model that serve, and why others do not (version to reason)."""

    versions: Mapping[int, LoadedVersion]
    refused: Mapping[int, str]

    @property
    def latest(self) -> LoadedVersion | None:
        """The highest version that serves."""
        return self.versions[max(self.versions)] if self.versions else None


NO_VERSIONS = ModelVersions({}, {})


@dataclass(frozen=True)
class IndexRow:
    """One version in the repository index; `version` is empty for a model none of whose versions is known."""

    name: str
    version: str
    state: str
    reason: str


class ModelStore:
    """Models by name and version. Any thread may read; loads and unloads run one after another."""

    def __init__(self, folders: Callable[[], Mapping[str, Path]]) -> None:
        """Load everything.

        Args:
            folders: Gives model name to model folder; called for each load and index.

        Raises:
            ModelError: If there is no model, or no version passes its checks.
        """
        self._folders = folders
        self._turn = threading.Lock()
        self._statistics: dict[tuple[str, int], Statistics] = {}
        self._entries: dict[str, ModelVersions] = {}
        self._answering: dict[tuple[str, str], LoadedVersion] = {}
        for name, folder in folders().items():
            self._put(name, self._load_versions(name, folder, {}))
        if not self._answering:
            raise ModelError(f"no model can be served: {'; '.join(self.refusals()) or 'no model was found'}")

    def get(self, name: str, version: str = "") -> LoadedVersion:
        """The model to answer with; the highest version if none is given.

        Raises:
            ModelNotFound: If it does not serve; the message says what does.
        """
        loaded = self._answering.get((name, version))
        if loaded is None:
            raise ModelNotFound(self._why_not(name, version))
        return loaded

    def label(self, name: str, version: str = "") -> str | None:
        """`name/version` of the model that would answer, None if none does."""
        loaded = self._answering.get((name, version))
        return None if loaded is None else loaded.metadata.label

    def _why_not(self, name: str, version: str) -> str:
        """Why a model does not serve, and what does."""
        entry = self._entries.get(name, NO_VERSIONS)
        reasons = dict.fromkeys(reason for v, reason in sorted(entry.refused.items()) if version in ("", str(v)))
        label = f"{name}/{version}" if version else name
        serving = ", ".join(sorted(loaded.metadata.label for loaded in self.all())) or "no model"
        return "; ".join([f"model {label!r:.200} is not found", f"serving: {serving}", *reasons])

    def all(self) -> list[LoadedVersion]:
        """Every version that serves, by name and version."""
        return [loaded for _, entry in sorted(self._entries.items()) for _, loaded in sorted(entry.versions.items())]

    def named(self, name: str) -> list[LoadedVersion]:
        """Every version of one model that serves, ascending.

        Raises:
            ModelNotFound: If none does.
        """
        self.get(name)
        return [loaded for loaded in self.all() if loaded.metadata.name == name]

    def versions(self, name: str) -> list[str]:
        """Versions of a model that serve, ascending."""
        return [str(version) for version in sorted(self._entries[name].versions)]

    def refusals(self) -> list[str]:
        """Why files were refused, a sentence for each version."""
        return [reason for _, entry in sorted(self._entries.items()) for _, reason in sorted(entry.refused.items())]

    def unready(self, *, full: bool) -> str:
        """Why the server is not ready, in a sentence; empty if it is.

        Args:
            full: With the reason for each version, which names files; without, only how many there are.
        """
        if self.all():
            return ""
        rows = self.known()
        if full:
            return "no model is loaded" + "".join(f"; {row.name}/{row.version}: {row.reason}" for row in rows)
        refused = sum(row.reason != UNLOADED for row in rows)
        return f"no model is loaded (versions refused: {refused}, unloaded: {len(rows) - refused})"

    def known(self) -> list[IndexRow]:
        """Every version that serves or was refused."""
        return [row for name, entry in sorted(self._entries.items()) for row in _rows(name, entry)]

    def index(self) -> list[IndexRow]:
        """Every version that serves or was refused, and models that nobody has loaded."""
        entries = self._entries
        return self.known() + [IndexRow(n, "", "UNAVAILABLE", "") for n in self._folders() if n not in entries]

    def counters(self) -> dict[tuple[str, str], Statistics]:
        """Counters of every version that has ever served, by name and version, as they are now."""
        counters = sorted(dict(self._statistics).items())
        return {(name, str(version)): statistics.snapshot() for (name, version), statistics in counters}

    def load(self, name: str) -> None:
        """Read a model's files again and put all its versions in place of the old ones.

        Raises:
            ModelNotFound: If the folders hold no such model.
            ModelError: If a version is refused; the others serve, and the old files of the refused one go on serving.
        """
        with self._turn:
            folder = self._folders().get(name)
            if folder is None:
                raise ModelNotFound(f"model {name!r:.200} is not found in the repository")
            known = self._entries.get(name)
            entry = self._load_versions(name, folder, known.versions if known else {})
            self._put(name, entry)
        if entry.refused:
            raise ModelError("; ".join(reason for _, reason in sorted(entry.refused.items())))

    def unload(self, name: str) -> None:
        """Stop serving a model; requests that have begun finish.

        Raises:
            ModelNotFound: If it does not serve.
        """
        with self._turn:
            self.get(name)
            versions = self._entries[name].versions
            self._put(name, ModelVersions({}, dict.fromkeys(versions, UNLOADED)))

    def _load_versions(self, name: str, folder: Path, old: Mapping[int, LoadedVersion]) -> ModelVersions:
        """Load every version; in place of a refused one, the old one stays."""
        versions, refused = {}, {}
        for version, path in version_folders(folder).items():
            try:
                versions[version] = _load_version(name, version, path, self._statistics_of(name, version))
            except Exception as error:  # a folder may be broken in any way, and must take no other model with it
                refused[version] = _reason(path, error)
                if version in old:
                    versions[version] = old[version]
        return ModelVersions(versions, refused)

    def _statistics_of(self, name: str, version: int) -> Statistics:
        """The counters of a version; they go on when its files are loaded again, as a counter never falls."""
        return self._statistics.setdefault((name, version), Statistics())

    def _put(self, name: str, entry: ModelVersions) -> None:
        """Change what serves in two assignments, so that a reader sees each change whole."""
        answering = {key: loaded for key, loaded in self._answering.items() if key[0] != name}
        answering |= {(name, str(version)): loaded for version, loaded in entry.versions.items()}
        if entry.latest is not None:
            answering[name, ""] = entry.latest
        self._answering = answering
        self._entries = self._entries | {name: entry}


def open_model_store(models: Path | None = None) -> ModelStore:
    """The models of one folder; without it, of every place where `find_model` looks, the first place winning.

    Raises:
        ModelError: If `models` is not a folder, holds no model, or none passes its checks.
    """
    roots = [models] if models is not None else repositories()
    if models is not None and not model_names(models):
        repositories(models)  # raises if the folder itself is missing
        raise ModelError(f"{models}: expected models, <name>/<version>/model.onnx, found none; correct --models")
    return ModelStore(lambda: MappingProxyType({n: root / n for root in reversed(roots) for n in model_names(root)}))


def _reason(folder: Path, error: Exception) -> str:
    """Why a version is refused; an error that isocharge did not raise on purpose goes into the log, too."""
    if isinstance(error, ModelError):
        return str(error)
    log.error("%s: the model cannot be checked", folder, exc_info=error)
    return f"{folder}: cannot be checked ({type(error).__name__}); copy or export the model again"


def _load_version(name: str, version: int, folder: Path, statistics: Statistics) -> LoadedVersion:
    model = load_model(folder)
    if (model.metadata.name, model.metadata.version) != (name, version):
        raise ModelError(
            f"{folder}: expected the model {name}/{version}, as the folders say, got {model.metadata.label}; "
            "move it into folders of that name and version"
        )
    check_golden(model)
    return LoadedVersion(model, model.metadata, str(version), statistics)


def _rows(name: str, entry: ModelVersions) -> list[IndexRow]:
    versions = sorted(set(entry.versions) | set(entry.refused))
    return [
        IndexRow(name, str(v), "READY" if v in entry.versions else "UNAVAILABLE", entry.refused.get(v, ""))
        for v in versions
    ]
