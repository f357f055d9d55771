import pytest
from knowledge_strategies import one_pass, plan

from knowledge import Knowledge, Log, QTable, RowLayout


def store(memory=8):
    return Knowledge(Log(RowLayout(("return",), 1, 3)), memory)


def table(value, n_states=2):
    made = QTable((0, 1), n_states)
    made.values[:] = value
    return made


def test_a_remembered_table_is_recalled_by_its_hash():
    knowledge, made = store(), table(3.0)
    key = knowledge.remember(made)
    assert key == made.sha256()
    assert knowledge.recall(key).sha256() == key


def test_what_is_remembered_does_not_change_with_the_table_or_with_what_was_recalled():
    knowledge, made = store(), table(3.0)
    key = knowledge.remember(made)
    made.values[:] = 0.0
    knowledge.recall(key).values[:] = 1.0
    assert knowledge.recall(key).values.tolist() == [[3.0, 3.0]] * 2


def test_one_more_than_fit_pushes_out_the_one_unused_for_longest():
    knowledge = store(memory=3)
    keys = [knowledge.remember(table(float(i))) for i in range(3)]
    knowledge.recall(keys[0])
    knowledge.remember(table(1.0))
    newest = knowledge.remember(table(9.0))
    with pytest.raises(LookupError, match=f"no Q-table {keys[2][:12]}.* is remembered; 3 others are"):
        knowledge.recall(keys[2])
    for key in (keys[0], keys[1], newest):
        assert knowledge.recall(key).sha256() == key


def test_a_table_that_was_never_remembered_is_not_recalled():
    with pytest.raises(LookupError, match="0 others are"):
        store().recall("0" * 64)


def test_the_q_table_is_read_through_its_writer():
    knowledge = store()
    with pytest.raises(LookupError, match="no Execute is there"):
        knowledge.q_table()
    knowledge.serve_q_table(lambda: table(2.0))
    assert knowledge.q_table().values[0, 0] == 2.0


def test_the_history_of_a_signal_is_that_of_the_window():
    knowledge = Knowledge(Log(RowLayout(("return",), 1, 3), window=3))
    knowledge.log.append(plan(0))
    for number in range(1, 6):
        for record in one_pass(number):
            knowledge.log.append(record)
    assert knowledge.history("return") == [-3.0, -4.0, -5.0]
    with pytest.raises(KeyError):
        knowledge.history("noise")
