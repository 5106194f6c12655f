"""Store of the models that a server uses. The store contains all versions of all models in one or more folders.

When the store loads a version of a model, it checks the checksum, the metadata and the shapes of the tensors, and
computes the golden vectors again. If a check fails, the version is refused, and the reason is stored. All other
versions remain available.

When a model is loaded again, its files are read into new sessions. The new sessions then replace the old sessions in a
single assignment. Requests that have already begun are answered with the old sessions. If the new files of a version
are refused, the old version remains available.
"""

import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily

from isocharge.common.errors import ModelError, ModelNotFound
from isocharge.common.files import StrPath
from isocharge.serve.model.model_folder import model_names, repositories, version_folders
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.network.metrics import Statistics


class LoadedVersion(Predictor):
    """Version of a model that is loaded and available for requests.

    Attributes:
        version: Number of the version as a text.
        statistics: Counters of the requests to this version.
    """

    def __init__(self, folder: Path, statistics: Statistics) -> None:
        """Load and check the version in a folder.

        Args:
            folder: Version folder.
            statistics: Counters of the requests to this version.

        Raises:
            ModelError: If the folder contains no valid model.
        """
        super().__init__(folder)
        self.version = str(self.metadata.version)
        self.statistics = statistics


class Version(NamedTuple):
    """Version of a model that is loaded, was refused or was unloaded.

    Attributes:
        name: Name of the model.
        number: Number of the version; 0 if the versions of the model are not known.
        loaded: The loaded version, or None if the version is not available for requests.
        reason: Reason why the version was refused or unloaded, or an empty text. A loaded version also has a reason if
            its new files were refused.
    """

    name: str
    number: int
    loaded: LoadedVersion | None = None
    reason: str = ""


class ModelStore:
    """Loaded models by name and version.

    Any thread may call any method. A lock ensures that only one thread at a time loads or unloads models.
    """

    def __init__(self, models: StrPath | None = None) -> None:
        """Load all versions of all models in one repository, or in all repositories that `find_model` searches.

        If several repositories contain a model, the model in the first of these repositories is used. The methods
        `load` and `index` search the repositories again, so that new models are found.

        Args:
            models: Folder of the only repository. By default, all repositories are searched.

        Raises:
            ModelError: If `models` is not a folder or contains no model, or if no version passes its checks.
        """
        roots = repositories(models)  # `models` first, and then the repositories that are always searched
        self._roots = roots if models is None else roots[:1]
        self._change_lock = threading.Lock()
        self._statistics = Statistics.of_all_versions()
        # Sorted versions by the name of their model. The table is replaced as a whole and never changed, so that no
        # thread reads half of a change.
        self._versions: dict[str, list[Version]] = {}
        self.load_all()
        if not self.versions_of():
            searched = ", ".join(map(str, self._roots))
            missing = f"expected models, <name>/<version>/model.onnx, found none in {searched}; correct --models"
            raise ModelError(f"no model can be served: {'; '.join(self.refusals()) or missing}")

    def get(self, name: str, version: str = "") -> LoadedVersion:
        """Return a loaded version of a model.

        Args:
            name: Name of the model.
            version: Number of the version as a text. An empty text means the highest loaded version.

        Raises:
            ModelNotFound: If the version is not loaded. The message lists the loaded versions, and states why the
                version was refused or unloaded.
        """
        versions = self.versions_of(name, version)  # loaded versions, sorted by number
        if versions:
            return versions[-1]
        label = f"{name}/{version}" if version else name
        available = ", ".join(loaded.metadata.label for loaded in self.versions_of()) or "no model"
        reasons = dict.fromkeys(self.refusals(name, version))  # without repetitions
        raise ModelNotFound("; ".join([f"model {label!r:.200} is not found", f"serving: {available}", *reasons]))

    def versions_of(self, name: str | None = None, version: str = "") -> list[LoadedVersion]:
        """Return loaded versions, sorted by name and number.

        Args:
            name: Name of the only model whose versions are returned. None selects all models.
            version: Number of the only version that is returned, as a text. An empty text selects all versions.
        """
        return [match.loaded for match in self._matching_versions(name, version) if match.loaded]

    def refusals(self, name: str | None = None, version: str = "") -> list[str]:
        """Return the reasons why versions were refused or unloaded. `versions_of` describes the arguments."""
        return [match.reason for match in self._matching_versions(name, version) if match.reason]

    def _matching_versions(self, name: str | None = None, version: str = "") -> list[Version]:
        """Return the versions that match the arguments of `versions_of`, whether or not they are loaded."""
        names = sorted(self._versions) if name is None else [name]
        candidates = [candidate for name in names for candidate in self._versions.get(name, ())]
        return [candidate for candidate in candidates if version in ("", str(candidate.number))]

    def index(self) -> list[dict[str, str]]:
        """Return one row for each version that is loaded, refused or unloaded, and for each model without versions.

        A row contains the name of the model, and the number and the state of the version. If the version was refused or
        unloaded, the row also contains the reason. The number is empty if no version of a model was found.
        """
        new_models = [Version(name, 0) for name in self._folders() if not self._matching_versions(name)]
        return [
            {
                "name": version.name,
                "version": str(version.number or ""),
                "state": "READY" if version.loaded else "UNAVAILABLE",
                "reason": version.reason,
            }
            for version in sorted([*self._matching_versions(), *new_models])
        ]

    def load_all(self) -> None:
        """Read the files of all models again. `refusals` returns the reasons why versions were refused.

        Raises:
            ModelError: If a repository cannot be listed.
        """
        with self._change_lock:
            folders = self._folders()
            for name in folders.keys() | self._versions.keys():
                self._load_versions(name, folders.get(name))

    def load(self, name: str) -> None:
        """Read the files of a model again, and replace its loaded versions.

        A loaded version is removed only if its folder no longer exists and all remaining versions are valid. A model
        therefore remains available while its folders are being copied or moved.

        Args:
            name: Name of the model.

        Raises:
            ModelNotFound: If the folders contain no such model.
            ModelError: If a version is refused. All valid versions are loaded nevertheless, and versions that were
                loaded before remain loaded.
        """
        with self._change_lock:
            folders = self._folders()
            self._load_versions(name, folders.get(name))
        if name not in folders:  # its loaded versions have just been kept, because no version was found
            raise ModelNotFound(f"model {name!r:.200} is not found in the repository")
        # All valid versions are loaded now. The error only reports which versions are refused.
        reasons = self.refusals(name)
        if reasons:
            raise ModelError("; ".join(reasons))

    def unload(self, name: str) -> None:
        """Remove all versions of a model. Requests that have already begun are still answered.

        Raises:
            ModelNotFound: If no version of the model is loaded.
        """
        with self._change_lock:
            self.get(name)  # raises ModelNotFound
            self._versions = self._versions | {
                name: [version._replace(loaded=None, reason="unloaded") for version in self._matching_versions(name)]
            }

    def _folders(self) -> Mapping[str, Path]:
        """Search the repositories for models, and return the folder of each model by the name of the model."""
        return {name: root / name for root in reversed(self._roots) for name in model_names(root)}

    def _load_versions(self, name: str, folder: Path | None) -> None:
        """Load every version in the folder of a model, and replace the versions that were loaded before.

        A version is refused if it cannot be loaded. Its field `reason` then states why, and is otherwise an empty text.

        Earlier versions that are no longer in the folder are removed. If a version is refused, or if the folder
        contains no version, the earlier versions are kept.

        Args:
            name: Name of the model.
            folder: Folder of the model, or None if there is no such folder.
        """
        # Loaded versions by number, without the reasons of earlier refusals
        earlier = {
            version.number: version._replace(reason="") for version in self._matching_versions(name) if version.loaded
        }
        found: dict[int, Version] = {}  # versions in the folder by number, loaded or refused
        try:
            folders = version_folders(folder) if folder else {}
        except ModelError as error:  # the folder cannot be listed
            folders = {}
            found[0] = Version(name, 0, reason=str(error))  # the number 0 stands for the whole model
        for number, version_folder in folders.items():
            try:
                loaded = LoadedVersion(version_folder, self._statistics.of(name, number))
                found[number] = Version(name, number, loaded)
            except Exception as error:  # any error in one folder must not affect the other models
                version = earlier.get(number, Version(name, number))  # keep what was loaded from the old files
                reason = str(error) if isinstance(error, ModelError) else f"{version_folder}: {error!r}"
                found[number] = version._replace(reason=reason)

        keeps_earlier = not found or any(version.reason for version in found.values())
        versions = earlier | found if keeps_earlier else found
        if versions or name in self._versions:  # a client cannot fill the table with names of missing models
            self._versions = self._versions | {name: sorted(versions.values())}

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics of all models for Prometheus. A registry calls this method."""
        ready = GaugeMetricFamily("isocharge_model_ready", "Whether a version is loaded.", labels=("model", "version"))
        for version in self._matching_versions():  # all versions of all models
            ready.add_metric((version.name, str(version.number)), version.loaded is not None)
        yield ready
        yield from self._statistics.collect()
