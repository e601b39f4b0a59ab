"""Blocks of the page on learning."""

from typing import Any

import pytest

from tests.support.docs.readme_pages import block

PAGE = "docs/howto/learning.md"


@pytest.mark.slow
@pytest.mark.processes
def test_blocks_of_the_page_run() -> None:
    names: dict[str, Any] = {}
    exec(block(PAGE, 'parallel_env("formation", seed=1'), names)
    assert names["infos"]["v0"].keys() == {"frames_sent", "received", "lost"}
    exec(block(PAGE, "gymnasium.make("), names)
    assert names["env"].reset(seed=1)[0].shape == names["env"].observation_space.shape
    exec(block(PAGE, 'vector_env("formation"'), names)
    assert names["observations"].shape == (256, 3, 29)
    assert names["rewards"].shape == (256, 3)
    exec(block(PAGE, "vcmvsp.start("), names)
    assert names["result"].metrics["duration_s"] == 60.0
