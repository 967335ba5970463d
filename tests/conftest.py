"""Selection of the quick suite: parameters that a test's mark `quick` does not match are slow."""

import fnmatch

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ids: dict[str, set[str]] = {}
    for item in items:
        mark = item.get_closest_marker("quick")
        if mark is None:
            continue
        name = item.callspec.id
        ids.setdefault(item.nodeid.split("[")[0], set()).add(name)
        if not any(fnmatch.fnmatchcase(name, pattern) for pattern in mark.args):
            item.add_marker(pytest.mark.slow)
    for item in items:
        mark = item.get_closest_marker("quick")
        if mark is not None:
            known = ids[item.nodeid.split("[")[0]]
            # A selection on the command line may have left single parameters out.
            if len(known) > 1:
                for pattern in mark.args:
                    assert any(fnmatch.fnmatchcase(name, pattern) for name in known), (
                        f"{item.nodeid}: no parameter is {pattern!r}"
                    )
