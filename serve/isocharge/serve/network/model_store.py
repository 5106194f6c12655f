"""Store of the models that a server uses: all versions of all models in its folders.

When a version is loaded, its checksum, its metadata and its shapes are checked, and its golden vectors are computed
again. A version that fails a check is refused, and the reason is stored. All other versions stay available.

When a model is loaded again, its files are read into new sessions, and one assignment then replaces the old sessions.
Requests that have begun are finished with the old sessions. If the new files of a version are refused, the old version
stays available.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType

from isocharge.common.errors import ModelError, ModelNotFound
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import (
    Model,
    load_checked_model,
    model_names,
    repositories,
    version_folders,
)
from isocharge.serve.model.session import BoundPress, output_widths
from isocharge.serve.network.traffic import Statistics
from isocharge.serve.prediction.contact import Validity

log = logging.getLogger(__name__)

UNLOADED = "unloaded"
"""Reason in the index for a model that a client unloaded."""


@dataclass(frozen=True)
class LoadedVersion:
    """One version of a model that is available for requests.

    Attributes:
        model: The model with its session.
        metadata: Metadata of the model.
        version: Version as a text.
        statistics: Counters of the requests to this version.
    """

    model: Model
    metadata: ModelMetadata
    version: str
    statistics: Statistics = field(default_factory=Statistics)
    _thread_local: threading.local = field(default_factory=threading.local, repr=False)

    @cached_property
    def validity(self) -> Validity:
        """Domain in which the model is valid."""
        return Validity.of(self.metadata)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of the model."""
        return tuple(output_widths(self.model.session))

    def press(self) -> BoundPress:
        """Return input and output memory for one press that is bound to the session of the model.

        Each thread has its own memory, which is allocated at the first call of the thread.
        """
        bound: BoundPress | None = getattr(self._thread_local, "press", None)
        if bound is None:
            bound = BoundPress(self.model.session, len(self.metadata.electrodes))
            self._thread_local.press = bound
        return bound


class ModelStore:
    """Models by name and version.

    All methods may be called from any thread. Loading and unloading are serialised by a lock.
    """

    def __init__(self, folders: Callable[[], Mapping[str, Path]]) -> None:
        """Load all versions of all models.

        Args:
            folders: Function that returns the folder of each model by its name. Each call of `load` and `index` calls
                this function.

        Raises:
            ModelError: If there is no model, or no version passes its checks.
        """
        self._folders = folders
        self._change_lock = threading.Lock()
        self._statistics: dict[tuple[str, int], Statistics] = {}
        # Versions by name and version. An empty version in the key means the highest version.
        self._loaded: dict[tuple[str, str], LoadedVersion] = {}
        self._refused: dict[tuple[str, int], str] = {}  # reasons for refusals by name and version
        for name, folder in folders().items():
            self._load_versions(name, folder)
        if not self._loaded:
            raise ModelError(f"no model can be served: {'; '.join(self.refusals()) or 'no model was found'}")

    def get(self, name: str, version: str = "") -> LoadedVersion:
        """Return a loaded version of a model.

        Args:
            name: Name of the model.
            version: Version; empty for the highest loaded version.

        Raises:
            ModelNotFound: If the version is not loaded. The message lists the loaded versions and the reason why this
                version was refused.
        """
        loaded = self._loaded.get((name, version))
        if loaded is None:
            raise ModelNotFound(self._not_found_message(name, version))
        return loaded

    def _not_found_message(self, name: str, version: str) -> str:
        """Return the message for a model that is not loaded.

        The message lists all loaded versions, and the reasons why versions of this model were refused.

        Args:
            name: Name of the model.
            version: Version; empty for any version.
        """
        label = f"{name}/{version}" if version else name
        loaded_labels = sorted(loaded.metadata.label for loaded in self.loaded_versions())
        available = ", ".join(loaded_labels) or "no model"
        reasons: list[str] = []
        for (refused_name, refused_version), reason in sorted(self._refused.items()):
            is_requested_version = version in ("", str(refused_version))
            is_requested = refused_name == name and is_requested_version
            if is_requested and reason not in reasons:
                reasons.append(reason)
        return "; ".join([f"model {label!r:.200} is not found", f"serving: {available}", *reasons])

    def label(self, name: str, version: str = "") -> str | None:
        """Return the label `name/version` of a version; None if this version is not loaded.

        Args:
            name: Name of the model.
            version: Version; empty for the highest loaded version.
        """
        loaded = self._loaded.get((name, version))
        return None if loaded is None else loaded.metadata.label

    def loaded_versions(self) -> list[LoadedVersion]:
        """Return all loaded versions, sorted by name and version."""
        versions = [loaded for (_, version), loaded in self._loaded.items() if version]
        return sorted(versions, key=lambda loaded: (loaded.metadata.name, loaded.metadata.version))

    def versions_of(self, name: str) -> list[LoadedVersion]:
        """Return the loaded versions of one model in ascending order.

        Raises:
            ModelNotFound: If no version of the model is loaded.
        """
        self.get(name)
        return [loaded for loaded in self.loaded_versions() if loaded.metadata.name == name]

    def refusals(self) -> list[str]:
        """Return the reason for each version that was refused."""
        return [reason for _, reason in sorted(self._refused.items())]

    def check_ready(self) -> None:
        """Check that at least one version is loaded.

        The error message contains no names of files, because it is sent to any client.

        Raises:
            ModelError: If no version is loaded.
        """
        if self._loaded:
            return
        unloaded_count = list(self._refused.values()).count(UNLOADED)
        refused_count = len(self._refused) - unloaded_count
        raise ModelError(
            f"not ready: no model is loaded (versions refused: {refused_count}, unloaded: {unloaded_count}); "
            "the repository's index has the reasons"
        )

    def version_states(self) -> list[dict[str, str]]:
        """Return the name, version, state and reason of every version that is loaded or was refused."""
        reasons = self._refused
        loaded_keys = {(loaded.metadata.name, loaded.metadata.version) for loaded in self.loaded_versions()}
        all_keys = loaded_keys | set(reasons)
        return [
            {
                "name": name,
                "version": str(version),
                "state": "READY" if (name, version) in loaded_keys else "UNAVAILABLE",
                "reason": reasons.get((name, version), ""),
            }
            for name, version in sorted(all_keys)
        ]

    def index(self) -> list[dict[str, str]]:
        """Return the rows of `version_states`, and one row for each model that has not been loaded."""
        rows = self.version_states()
        listed_names = {row["name"] for row in rows}
        for name in self._folders():
            if name not in listed_names:
                rows.append({"name": name, "version": "", "state": "UNAVAILABLE", "reason": ""})
        return rows

    def counters(self) -> dict[tuple[str, str], Statistics]:
        """Return the present counters, by name and version, of every version that has ever been loaded."""
        counters = sorted(dict(self._statistics).items())
        return {(name, str(version)): statistics.snapshot() for (name, version), statistics in counters}

    def load(self, name: str) -> None:
        """Read the files of a model again, and replace its versions.

        A loaded version is removed only if its folder has disappeared and all other versions are valid. A model
        therefore stays available while its folders are copied or moved.

        Raises:
            ModelNotFound: If the folders contain no such model.
            ModelError: If a version is refused, or no version is found. Versions that were loaded before stay loaded,
                with their new files if these are valid.
        """
        with self._change_lock:
            folder = self._folders().get(name)
            if folder is None:
                raise ModelNotFound(f"model {name!r:.200} is not found in the repository")
            refused = self._load_versions(name, folder)
        # The valid versions are loaded in any case. The errors only report what was not loaded.
        if refused:
            raise ModelError("; ".join(refused.values()))
        if not version_folders(folder):
            raise ModelError(
                f"{folder}: expected folders of versions, found none; versions that were loaded before stay loaded, "
                "and unload removes them"
            )

    def unload(self, name: str) -> None:
        """Remove all versions of a model. Requests that have begun still finish.

        Raises:
            ModelNotFound: If no version of the model is loaded.
        """
        with self._change_lock:
            reasons = {(name, loaded.metadata.version): UNLOADED for loaded in self.versions_of(name)}
            self._replace(name, [], reasons)

    def _load_versions(self, name: str, folder: Path) -> dict[tuple[str, int], str]:
        """Load every version of a model from its folder, and replace the versions that were loaded before.

        If a version is refused, or no version is found, the other versions that were loaded before stay loaded.

        Args:
            name: Name of the model.
            folder: Folder of the model.

        Returns:
            Reasons why versions were refused, by name and version.
        """
        loaded: dict[int, LoadedVersion] = {}
        refused: dict[tuple[str, int], str] = {}
        for version, version_folder in version_folders(folder).items():
            # The counters continue when files are loaded again, because a Prometheus counter must never decrease.
            statistics = self._statistics.setdefault((name, version), Statistics())
            try:
                loaded[version] = _load_version(name, version, version_folder, statistics)
            except Exception as error:  # A folder may be broken in any way, and must not affect other models.
                refused[name, version] = _refusal_reason(version_folder, error)
        if refused or not loaded:
            loaded = self._loaded_by_version(name) | loaded
        ascending_versions = [loaded[version] for version in sorted(loaded)]
        self._replace(name, ascending_versions, refused)
        return refused

    def _loaded_by_version(self, name: str) -> dict[int, LoadedVersion]:
        """Return the loaded versions of a model by version; empty if there are none."""
        return {loaded.metadata.version: loaded for loaded in self.loaded_versions() if loaded.metadata.name == name}

    def _replace(self, name: str, versions: list[LoadedVersion], refused: dict[tuple[str, int], str]) -> None:
        """Replace the versions of a model, and the reasons why versions were refused.

        Each dictionary is replaced by one assignment, so that readers need no lock.

        Args:
            name: Name of the model.
            versions: New versions of the model, in ascending order.
            refused: Reasons why versions were refused, by name and version.
        """
        loaded = {
            (other_name, version): other_version
            for (other_name, version), other_version in self._loaded.items()
            if other_name != name
        }
        for new_version in versions:
            loaded[name, new_version.version] = new_version
        if versions:
            loaded[name, ""] = versions[-1]  # the highest version

        other_refused = {
            (other_name, version): reason
            for (other_name, version), reason in self._refused.items()
            if other_name != name
        }
        self._refused = other_refused | refused
        self._loaded = loaded


def open_model_store(models: Path | None = None) -> ModelStore:
    """Load all models of one repository, or of all repositories that `find_model` searches.

    Args:
        models: The only repository. By default all repositories are searched; if a model is in several repositories,
            the first one is used.

    Raises:
        ModelError: If `models` is not a folder or contains no model, or no version passes its checks.
    """
    if models is None:
        return ModelStore(partial(_find_model_folders, repositories()))
    if not model_names(models):
        repositories(models)  # raises an error if the folder itself is missing
        raise ModelError(f"{models}: expected models, <name>/<version>/model.onnx, found none; correct --models")
    return ModelStore(partial(_find_model_folders, [models]))


def _find_model_folders(roots: Sequence[Path]) -> Mapping[str, Path]:
    """Return the present folder of each model by its name.

    Args:
        roots: Repositories. If a model is in several repositories, the first one takes precedence.
    """
    folder_of_model: dict[str, Path] = {}
    for root in roots:
        for name in model_names(root):
            folder_of_model.setdefault(name, root / name)
    return MappingProxyType(folder_of_model)


def _refusal_reason(folder: Path, error: Exception) -> str:
    """Return the reason why a version is refused. An error that is not a ModelError is also written to the log."""
    if isinstance(error, ModelError):
        return str(error)
    log.error("%s: the model cannot be checked", folder, exc_info=error)
    return f"{folder}: cannot be checked ({type(error).__name__}); copy or export the model again"


def _load_version(name: str, version: int, folder: Path, statistics: Statistics) -> LoadedVersion:
    """Load one version of a model, check it, and return it.

    Args:
        name: Name of the model, which is the name of the parent folder.
        version: Version, which is the name of the folder.
        folder: Folder of the version.
        statistics: Counters of the version.

    Raises:
        ModelError: If a check fails, or the metadata name another model than the folders.
    """
    model = load_checked_model(folder)
    if model.metadata.name != name:
        raise ModelError(
            f"{folder}: expected the model {name}/{version}, as the folders say, got {model.metadata.label}; "
            "move it into folders of that name and version"
        )
    return LoadedVersion(model, model.metadata, str(version), statistics)
