"""Work in parallel: threads of one pool start no others."""

import threading

from pbrl_ppl.system.threads import Work, in_parallel, in_worker


def test_values_come_in_the_order_of_their_arguments() -> None:
    assert in_parallel(lambda n: n * n, range(20)) == [n * n for n in range(20)]


def test_threads_of_the_pool_start_no_others() -> None:
    """Two loops beside each other would fight for the processors with four and eight threads."""

    def inside(_: int) -> tuple[bool, bool]:
        here = threading.get_ident()
        return in_worker(), set(in_parallel(lambda _: threading.get_ident(), range(3))) == {here}

    assert not in_worker()
    assert in_parallel(inside, range(4)) == [(True, True)] * 4
    assert not in_worker()


def test_what_runs_inside_is_counted_as_well() -> None:
    said: list[Work] = []

    def inside(_: int) -> None:
        in_parallel(str, range(3), "inner", lambda work: said.append(work))  # type: ignore[arg-type]

    in_parallel(inside, range(1))
    assert [(work.done, work.total) for work in said] == [(0, 3), (1, 3), (2, 3), (3, 3)]
