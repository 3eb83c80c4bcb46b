"""Fewer threads of libraries."""

from __future__ import annotations

import os
import threading

import pytest
import torch

from beags_plugin.system.fewer_threads import one_processor, one_torch_thread


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="only Linux binds threads to processors here")
def test_threads_of_the_block_share_a_processor_and_those_after_it_do_not():
    former, inside = os.sched_getaffinity(0), []
    with one_processor():
        thread = threading.Thread(target=lambda: inside.append(os.sched_getaffinity(0)))
        thread.start()
        thread.join()
        assert len(inside[0]) == 1 and os.sched_getaffinity(0) == inside[0] <= former
    assert os.sched_getaffinity(0) == former


def test_the_block_runs_where_threads_cannot_be_bound(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    with one_processor():
        pass


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="only Linux binds threads to processors here")
def test_errors_leave_no_thread_bound():
    former = os.sched_getaffinity(0)
    with pytest.raises(ZeroDivisionError), one_processor():
        raise ZeroDivisionError
    assert os.sched_getaffinity(0) == former


def test_torch_has_its_threads_again_after_an_error():
    former = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(ZeroDivisionError), one_torch_thread():
            assert torch.get_num_threads() == 1
            raise ZeroDivisionError
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(former)
