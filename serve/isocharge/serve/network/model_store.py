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
from isocharge.serve.model.model_folder import (
    Model,
    check_golden,
    load_model,
    model_names,
    repositories,
    version_folders,
)
from isocharge.serve.model.session import BoundPress, output_widths
from isocharge.serve.network.traffic import Statistics
from isocharge.serve.prediction.contact import Validity

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
    def validity(self) -> Validity:
        """Where it may be trusted."""
        return Validity.of(self.metadata)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that the model has."""
        return tuple(output_widths(self.model.session))

    def press(self) -> BoundPress:
        """Bound memory for one press; each thread has its own."""
        bound: BoundPress | None = getattr(self._of_thread, "press", None)
        if bound is None:
            bound = self._of_thread.press = BoundPress(self.model.session, len(self.metadata.electrodes))
        return bound


class ModelStore:
    """Models by name and version. Any thread may read; loads and unloads run one after another."""

    def __init__(self, folders: Callable[[], Mapping[str, Path]]) -> None:
        """Load everything.

        Args:
            folders: Gives model name to model folder; called for each load and index.

        Raises:
            ModelError: If there is no model, or no version passes its checks.
        """
        self._folders, self._turn = folders, threading.Lock()
        self._statistics: dict[tuple[str, int], Statistics] = {}
        self._serving: dict[tuple[str, str], LoadedVersion] = {}  # by name and version; without version, the highest
        self._refused: dict[tuple[str, int], str] = {}
        for name, folder in folders().items():
            self._load(name, folder)
        if not self._serving:
            raise ModelError(f"no model can be served: {'; '.join(self.refusals()) or 'no model was found'}")

    def get(self, name: str, version: str = "") -> LoadedVersion:
        """The model to answer with; the highest version if none is given.

        Raises:
            ModelNotFound: If it does not serve; the message says what does, and why not this one.
        """
        loaded = self._serving.get((name, version))
        if loaded is None:
            label = f"{name}/{version}" if version else name
            serving = ", ".join(sorted(loaded.metadata.label for loaded in self.all())) or "no model"
            reasons = [why for (of, v), why in sorted(self._refused.items()) if of == name and version in ("", str(v))]
            said = [f"model {label!r:.200} is not found", f"serving: {serving}", *dict.fromkeys(reasons)]
            raise ModelNotFound("; ".join(said))
        return loaded

    def label(self, name: str, version: str = "") -> str | None:
        """`name/version` of the model that would answer, None if none does."""
        loaded = self._serving.get((name, version))
        return None if loaded is None else loaded.metadata.label

    def all(self) -> list[LoadedVersion]:
        """Every version that serves, by name and version."""
        serving = [loaded for (_, version), loaded in self._serving.items() if version]
        return sorted(serving, key=lambda loaded: (loaded.metadata.name, loaded.metadata.version))

    def named(self, name: str) -> list[LoadedVersion]:
        """Every version of one model that serves, ascending.

        Raises:
            ModelNotFound: If none does.
        """
        self.get(name)
        return [loaded for loaded in self.all() if loaded.metadata.name == name]

    def refusals(self) -> list[str]:
        """Why files were refused, a sentence for each version."""
        return [reason for _, reason in sorted(self._refused.items())]

    def check_ready(self) -> None:
        """Check that a model serves; the message is for everybody, and names no file.

        Raises:
            ModelError: If none does.
        """
        if not self._serving:
            unloaded = list(self._refused.values()).count(UNLOADED)
            raise ModelError(
                f"not ready: no model is loaded (versions refused: {len(self._refused) - unloaded}, unloaded: "
                f"{unloaded}); the repository's index has the reasons"
            )

    def known(self) -> list[dict[str, str]]:
        """Name, version, state and reason of every version that serves or was refused."""
        refused, serving = self._refused, self._serving
        versions = sorted({(loaded.metadata.name, loaded.metadata.version) for loaded in self.all()} | set(refused))
        return [
            {
                "name": name,
                "version": str(version),
                "state": "READY" if (name, str(version)) in serving else "UNAVAILABLE",
                "reason": refused.get((name, version), ""),
            }
            for name, version in versions
        ]

    def index(self) -> list[dict[str, str]]:
        """Every version that serves or was refused, and models that nobody has loaded."""
        known = self.known()
        names = {row["name"] for row in known}
        nothing = {"version": "", "state": "UNAVAILABLE", "reason": ""}
        return known + [{"name": name} | nothing for name in self._folders() if name not in names]

    def counters(self) -> dict[tuple[str, str], Statistics]:
        """Counters of every version that has ever served, by name and version, as they are now."""
        counters = sorted(dict(self._statistics).items())
        return {(name, str(version)): statistics.snapshot() for (name, version), statistics in counters}

    def load(self, name: str) -> None:
        """Read a model's files again and replace its versions.

        A version that served before is removed only if its folder is gone and every version that was found is valid. So
        no model disappears while its folders are being copied or moved.

        Raises:
            ModelNotFound: If the folders hold no such model.
            ModelError: If a version is refused, or no version is found. Every version that served before goes on
                serving, with its new files if these are valid.
        """
        with self._turn:
            folder = self._folders().get(name)
            if folder is None:
                raise ModelNotFound(f"model {name!r:.200} is not found in the repository")
            refused = self._load(name, folder)
        if refused:
            raise ModelError("; ".join(refused.values()))
        if not version_folders(folder):
            raise ModelError(
                f"{folder}: expected folders of versions, found none; what served before goes on serving, and unload "
                "stops it"
            )

    def unload(self, name: str) -> None:
        """Stop serving a model; requests that have begun finish.

        Raises:
            ModelNotFound: If it does not serve.
        """
        with self._turn:
            self._put(name, [], {(name, loaded.metadata.version): UNLOADED for loaded in self.named(name)})

    def _load(self, name: str, folder: Path) -> dict[tuple[str, int], str]:
        """Load every version of a model.

        Returns:
            Reasons why versions were refused, by name and version.
        """
        loaded: dict[int, LoadedVersion] = {}
        refused: dict[tuple[str, int], str] = {}
        for version, path in version_folders(folder).items():
            # The counters continue when files are loaded again, because a counter must never fall.
            statistics = self._statistics.setdefault((name, version), Statistics())
            try:
                loaded[version] = _load_version(name, version, path, statistics)
            except Exception as error:  # A folder may be broken in any way, and must not affect other models.
                refused[name, version] = _reason(path, error)
        if refused or not loaded:
            loaded = self._versions_of(name) | loaded
        self._put(name, [loaded[version] for version in sorted(loaded)], refused)
        return refused

    def _versions_of(self, name: str) -> dict[int, LoadedVersion]:
        """Return the versions of a model that serve now; empty if there are none."""
        return {int(version): loaded for (of, version), loaded in self._serving.items() if of == name and version != ""}

    def _put(self, name: str, versions: list[LoadedVersion], refused: dict[tuple[str, int], str]) -> None:
        """Change what serves in one assignment, so that a reader sees each change whole."""
        serving = {key: loaded for key, loaded in self._serving.items() if key[0] != name}
        serving |= {(name, loaded.version): loaded for loaded in versions}
        if versions:
            serving[name, ""] = versions[-1]
        self._refused = {key: reason for key, reason in self._refused.items() if key[0] != name} | refused
        self._serving = serving


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
