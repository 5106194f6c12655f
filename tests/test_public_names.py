"""Public names of the three packages: tab completion lists them, and each can be imported."""

import sys
from importlib import import_module

import pytest

from processes import finished

PACKAGES = ["isocharge.simulate", "isocharge.train", "isocharge.serve"]


@pytest.mark.parametrize("package", PACKAGES)
def test_dir_lists_the_public_names_before_their_first_use(package):
    """The test runs in a new process, because a name becomes an ordinary attribute when it is used once."""
    code = f"""import sys, {package} as package
print(dir(package) == package.__all__, sys.modules.keys() & {{"torch", "isocharge.simulate.solver"}})"""
    done = finished([sys.executable, "-c", code])
    assert done.stdout == "True set()\n"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_can_be_imported_and_a_misspelt_one_is_an_attribute_error(package):
    module = import_module(package)
    assert all(getattr(module, name) is not None for name in module.__all__)
    assert sorted(module.__all__) == module.__all__
    with pytest.raises(AttributeError, match="has no attribute 'calibrat'"):
        module.calibrat  # noqa: B018


def test_a_sweep_imports_no_part_of_serve():
    code = """import sys, isocharge.cli.simulate.sweep
print(sorted({".".join(name.split(".")[:3]) for name in sys.modules if name.startswith("isocharge.serve.")}))"""
    done = finished([sys.executable, "-c", code])
    assert done.stdout == "[]\n"
