"""The page that lists every key is the one that the tables make."""

from __future__ import annotations

from benchmark_scripts import script

from ns_abstract.geometry import path_keys
from ns_abstract.methods import config_keys


def test_the_page_lists_every_key() -> None:
    keys_page = script("keys_page")
    assert keys_page.PAGE.read_text(encoding="utf-8") == keys_page.page()
    for table in (*config_keys.TABLES, *path_keys.TABLES):
        for key in table.keys:
            assert f"\n| `{key.name}` | {key.status}" in keys_page.page()
            assert key.why and (key.status != "refused" or key.fix)
