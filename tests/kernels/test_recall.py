"""What a process remembers of the kernels it has made."""

from polarmpm.kernels import recall
from polarmpm.kernels.recall import recalled


def test_made_once_for_an_equal_key_and_always_without_one():
    made: list[int] = []

    def make() -> int:
        made.append(len(made))
        return made[-1]

    key = ("test_recall", (1, 2))
    assert recalled(key, make) == recalled(("test_recall", (1, 2)), make) == 0
    assert recalled(("test_recall", (1, 3)), make) == 1
    assert [recalled(None, make) for _ in range(2)] == [2, 3]


def test_forgets_what_has_not_been_asked_for_longest(monkeypatch):
    monkeypatch.setattr(recall, "_known", type(recall._known)())
    monkeypatch.setattr(recall, "_MOST", 3)
    for k in (1, 2, 3, 1, 4):
        recalled(k, lambda k=k: k)
    assert list(recall._known) == [3, 1, 4]
