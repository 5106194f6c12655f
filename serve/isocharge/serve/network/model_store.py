"""Store of the models that a server uses. The store contains all versions of all models in one or more folders.

When the store loads a version of a model, it checks the checksum, the metadata and the shapes of the tensors, and
computes the golden vectors again. If a check fails, the version is refused, and the reason is stored. All other
versions remain available.

When a model is loaded again, its files are read into new sessions. The new sessions then replace the old sessions in a
single assignment. Requests that have already begun are answered with the old sessions. If the new files of a version
are refused, the old version remains available.
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
from isocharge.serve.model.model_folder import Model, load_checked_model
from isocharge.serve.model.model_search import model_names, repositories, version_folders
from isocharge.serve.model.session import BoundPress
from isocharge.serve.model.validity import Validity
from isocharge.serve.network.metrics import ModelMetrics, Statistics

log = logging.getLogger(__name__)

UNLOADED = "unloaded"
"""Reason in the index if a client has unloaded the model."""


@dataclass(frozen=True)
class LoadedVersion:
    """Version of a model that is loaded and available for requests.

    Attributes:
        model: The model, which contains its session of onnxruntime.
        metadata: Metadata of the model.
        version: Number of the version as a text.
        statistics: Counters of the requests to this version.
    """

    model: Model
    metadata: ModelMetadata
    version: str
    statistics: Statistics
    _thread_local: threading.local = field(default_factory=threading.local, repr=False)

    @cached_property
    def validity(self) -> Validity:
        """Limits within which the contacts that the model estimates are valid."""
        return Validity.of(self.metadata)

    def press_of_thread(self) -> BoundPress:
        """Return an object that runs the model for single presses and reuses the memory of earlier presses.

        Each thread has its own object, which is created when the thread calls this method for the first time.
        """
        press: BoundPress | None = getattr(self._thread_local, "press", None)
        if press is None:
            press = BoundPress(self.model.session, len(self.metadata.electrodes))
            self._thread_local.press = press
        return press


class ModelStore:
    """Loaded models by name and version.

    Any thread may call any method. A lock ensures that only one thread at a time loads or unloads models.

    Attributes:
        metrics: Metrics of the requests to each version. They also contain versions that are no longer loaded.
    """

    def __init__(self, folders: Callable[[], Mapping[str, Path]]) -> None:
        """Load all versions of all models in the folders.

        Args:
            folders: Function that returns the folder of each model by the name of the model. The methods `load` and
                `index` call this function again, so that new models are found.

        Raises:
            ModelError: If there is no model, or no version passes its checks.
        """
        self._folders = folders
        self._change_lock = threading.Lock()
        self.metrics = ModelMetrics()
        self._statistics: dict[tuple[str, int], Statistics] = {}
        # Loaded versions by name and version. The empty version in a key stands for the highest loaded version.
        self._loaded: dict[tuple[str, str], LoadedVersion] = {}
        self._refused: dict[tuple[str, int], str] = {}  # reasons why versions were refused, by name and version
        for name, folder in folders().items():
            self._load_versions(name, folder)
        if not self._loaded:
            raise ModelError(f"no model can be served: {'; '.join(self.refusals()) or 'no model was found'}")

    def get(self, name: str, version: str = "") -> LoadedVersion:
        """Return a loaded version of a model.

        Args:
            name: Name of the model.
            version: Number of the version as a text. An empty text means the highest loaded version.

        Raises:
            ModelNotFound: If the version is not loaded. The message lists the loaded versions, and states why the
                version was refused or unloaded.
        """
        loaded = self._loaded.get((name, version))
        if loaded is None:
            raise ModelNotFound(self._not_found_message(name, version))
        return loaded

    def _not_found_message(self, name: str, version: str) -> str:
        """Return the error message for a model or a version that is not loaded.

        The message lists all loaded versions. If the requested version was refused or unloaded, the message also
        contains the reason.

        Args:
            name: Name of the model.
            version: Number of the requested version as a text. An empty text means that any version was requested. The
                message then contains the reasons for all versions of the model.
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
        """Return the label `name/version` of a version, or None if the version is not loaded.

        Args:
            name: Name of the model.
            version: Number of the version as a text. An empty text means the highest loaded version.
        """
        loaded = self._loaded.get((name, version))
        return None if loaded is None else loaded.metadata.label

    def loaded_versions(self) -> list[LoadedVersion]:
        """Return all loaded versions of all models, sorted by name and version."""
        versions = [loaded for (_, version), loaded in self._loaded.items() if version]
        return sorted(versions, key=lambda loaded: (loaded.metadata.name, loaded.metadata.version))

    def versions_of(self, name: str) -> list[LoadedVersion]:
        """Return the loaded versions of one model, in ascending order of their numbers.

        Raises:
            ModelNotFound: If no version of the model is loaded.
        """
        self.get(name)  # raises ModelNotFound
        return [loaded for loaded in self.loaded_versions() if loaded.metadata.name == name]

    def refusals(self) -> list[str]:
        """Return the reasons why versions were refused or unloaded, sorted by name and version."""
        return [reason for _, reason in sorted(self._refused.items())]

    def check_ready(self) -> None:
        """Check that at least one version of a model is loaded.

        The error message contains no names of files, because it is also sent to clients without a token.

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
        """Return one row for every version that is loaded, was refused or was unloaded.

        A row contains the name of the model, and the number and the state of the version. If the version was refused or
        unloaded, the row also contains the reason.
        """
        reasons = self._refused
        loaded_keys = {(loaded.metadata.name, loaded.metadata.version) for loaded in self.loaded_versions()}
        all_keys = loaded_keys | set(reasons)  # a loaded version whose new files were refused is in both sets
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
        """Return the rows of `version_states`, followed by one row for each model that has no version among them."""
        rows = self.version_states()
        listed_names = {row["name"] for row in rows}
        for name in self._folders():
            if name not in listed_names:
                rows.append({"name": name, "version": "", "state": "UNAVAILABLE", "reason": ""})
        return rows

    def load(self, name: str) -> None:
        """Read the files of a model again, and replace its loaded versions.

        A loaded version is removed only if its folder no longer exists and all remaining versions are valid. A model
        therefore remains available while its folders are being copied or moved.

        Args:
            name: Name of the model.

        Raises:
            ModelNotFound: If the folders contain no such model.
            ModelError: If a version is refused, or if the model has no version. In both cases, all valid versions are
                loaded, and versions that were loaded before remain loaded.
        """
        with self._change_lock:
            folder = self._folders().get(name)
            if folder is None:
                raise ModelNotFound(f"model {name!r:.200} is not found in the repository")
            refused = self._load_versions(name, folder)
        # All valid versions are loaded now. The following errors only report which versions are not loaded.
        if refused:
            raise ModelError("; ".join(refused.values()))
        if not version_folders(folder):
            raise ModelError(
                f"{folder}: expected folders of versions, found none; versions that were loaded before stay loaded, "
                "and unload removes them"
            )

    def unload(self, name: str) -> None:
        """Remove all versions of a model. Requests that have already begun are still answered.

        Raises:
            ModelNotFound: If no version of the model is loaded.
        """
        with self._change_lock:
            reasons = {(name, loaded.metadata.version): UNLOADED for loaded in self.versions_of(name)}
            self._replace(name, [], reasons)

    def _load_versions(self, name: str, folder: Path) -> dict[tuple[str, int], str]:
        """Load every version in the folder of a model, and replace the versions that were loaded before.

        If a version is refused, or if no version is found, every earlier version that was not replaced remains loaded.

        Args:
            name: Name of the model.
            folder: Folder of the model.

        Returns:
            Reasons why versions were refused, by name and version.
        """
        new_versions: dict[int, LoadedVersion] = {}
        refused: dict[tuple[str, int], str] = {}
        for version, version_folder in version_folders(folder).items():
            # The counters continue when files are loaded again, because a Prometheus counter must never decrease.
            if (name, version) not in self._statistics:
                self._statistics[name, version] = Statistics(self.metrics, name, version)
            statistics = self._statistics[name, version]
            try:
                new_versions[version] = _load_version(name, version, version_folder, statistics)
            except Exception as error:  # any error in one folder must not affect the other models
                refused[name, version] = _refusal_reason(version_folder, error)
        available_versions = new_versions
        if refused or not new_versions:  # keep the versions that were loaded before, unless new files replace them
            available_versions = self._loaded_by_version(name) | new_versions
        ascending_versions = [available_versions[version] for version in sorted(available_versions)]
        self._replace(name, ascending_versions, refused)
        return refused

    def _loaded_by_version(self, name: str) -> dict[int, LoadedVersion]:
        """Return the loaded versions of a model by the number of the version."""
        return {loaded.metadata.version: loaded for loaded in self.loaded_versions() if loaded.metadata.name == name}

    def _replace(self, name: str, versions: list[LoadedVersion], refused: dict[tuple[str, int], str]) -> None:
        """Replace the loaded versions of a model, and the reasons why its versions were refused or unloaded.

        Each dictionary is replaced by a new dictionary in a single assignment. Other threads can therefore read the
        dictionaries without a lock.

        Args:
            name: Name of the model.
            versions: New loaded versions of the model, in ascending order. If the list is empty, the model is removed.
            refused: Reasons why versions were refused or unloaded, by name and version.
        """
        loaded = {
            (other_name, version): other_loaded
            for (other_name, version), other_loaded in self._loaded.items()
            if other_name != name
        }
        for new_version in versions:
            loaded[name, new_version.version] = new_version
        if versions:
            loaded[name, ""] = versions[-1]  # the empty version stands for the highest version

        other_refused = {
            (other_name, version): reason
            for (other_name, version), reason in self._refused.items()
            if other_name != name
        }
        self._refused = other_refused | refused
        self._loaded = loaded
        for (known_name, version), statistics in self._statistics.items():
            statistics.ready.set((known_name, str(version)) in loaded)


def open_model_store(models: Path | None = None) -> ModelStore:
    """Load all models in one repository, or in all repositories that `find_model` searches.

    Args:
        models: Folder of the only repository. By default, all repositories are searched. If several repositories
            contain a model, the model in the first of them is used.

    Raises:
        ModelError: If `models` is not a folder or contains no model, or if no version passes its checks.
    """
    if models is None:
        return ModelStore(partial(_find_model_folders, repositories()))
    if not model_names(models):
        repositories(models)  # raises an error if the folder itself is missing
        raise ModelError(f"{models}: expected models, <name>/<version>/model.onnx, found none; correct --models")
    return ModelStore(partial(_find_model_folders, [models]))


def _find_model_folders(roots: Sequence[Path]) -> Mapping[str, Path]:
    """Search repositories for models, and return the folder of each model by the name of the model.

    Args:
        roots: Folders of the repositories. If several repositories contain a model, its folder in the first of them is
            returned.
    """
    folder_of_model: dict[str, Path] = {}
    for root in roots:
        for name in model_names(root):
            folder_of_model.setdefault(name, root / name)
    return MappingProxyType(folder_of_model)


def _refusal_reason(folder: Path, error: Exception) -> str:
    """Return the reason why a version is refused.

    Every error other than a ModelError is unexpected, and is therefore also written to the log with its traceback.

    Args:
        folder: Folder of the version.
        error: Error that has occurred while the version was loaded and checked.
    """
    if isinstance(error, ModelError):
        return str(error)
    log.error("%s: the model cannot be checked", folder, exc_info=error)
    return f"{folder}: cannot be checked ({type(error).__name__}); copy or export the model again"


def _load_version(name: str, version: int, folder: Path, statistics: Statistics) -> LoadedVersion:
    """Load one version of a model, check its files, and return the version.

    Args:
        name: Name of the model, which is the name of the parent folder.
        version: Number of the version, which is the name of the folder.
        folder: Folder of the version.
        statistics: Counters of the requests to this version, which may have begun before.

    Raises:
        ModelError: If a check fails, or if the metadata contain another name than the folder.
    """
    model = load_checked_model(folder)
    if model.metadata.name != name:
        raise ModelError(
            f"{folder}: expected the model {name}/{version}, as the folders say, got {model.metadata.label}; "
            "move it into folders of that name and version"
        )
    statistics.description.info({"sensor": model.metadata.frame_id, "sha256": model.golden.sha256})
    return LoadedVersion(model, model.metadata, str(version), statistics)
