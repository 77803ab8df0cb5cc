from importlib import metadata

from madoc.runs.versions import versions


def test_the_version_of_mujoco_is_that_of_its_core_where_it_has_one(monkeypatch):
    installed = {"mujoco": "4.0.0", "mujoco-core": "4.0.1"}

    def version(package):
        if package not in installed:
            raise metadata.PackageNotFoundError
        return installed[package]

    monkeypatch.setattr(metadata, "version", version)
    assert versions()["mujoco"] == "4.0.1"
    del installed["mujoco-core"]
    assert versions()["mujoco"] == "4.0.0"
    installed.clear()
    assert versions()["mujoco"] == "not installed"
