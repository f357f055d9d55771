"""Every right and every denial between real sessions, over TLS and with a token.

Denied: nothing arrives, and nobody answers.
"""

from contextlib import ExitStack

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from security_deployment import REMOTE, STATUS, Deployment, ask, direct, eventually, in_order, sign

from adapters.buses import security, tokens

STAGES = {"execute", "monitor", "analyze", "plan"}
CLIENTS = STAGES | {"operator"}
NOBODY = set()


@pytest.fixture(scope="module", params=["keys", "token"])
def everybody(request, shared_keys, tmp_path_factory):
    """Knowledge and all roles, each with a session; stages answer at their own control key."""
    if request.param == "keys":
        whole = Deployment(shared_keys)
    else:
        place = tmp_path_factory.mktemp("token") / "t.token"
        whole = Deployment(token=tokens.make("tcp/127.0.0.1:1", security.CLIENTS, place))
    with whole as running, ExitStack() as declared:
        join_all(running)
        for role in STAGES:
            key = f"mape/s/control/{role}"
            answer = direct(lambda query, role=role, key=key: reply(query, key, role))
            declared.enter_context(running.sessions[role].declare_queryable(key, answer))
        settle(running)
        yield running


def join_all(running):
    running.sessions = {role: running.join(role) for role in sorted(CLIENTS)}


def reply(query, key, text):
    with query:
        query.reply(key, text)


def settle(running):
    for session in running.sessions.values():
        in_order(session)


# Who may ask what.

OWN = ("join", "snapshot", "swapped", "event")
QUERIES = {
    **{f"mape/s/0/append/{role}": {role} for role in STAGES},
    **{f"mape/s/17/append/{role}": {role} for role in STAGES},
    **{
        f"mape/s/knowledge/{word}/{role}": {role}
        for word in ("join", "snapshot", "swapped", "event")
        for role in STAGES
    },
    "mape/*/knowledge/join/plan": {"plan"},
    "mape/s/*/append/plan": {"plan"},
    "mape/s/knowledge/remember/plan": {"plan"},
    "mape/s/knowledge/since": CLIENTS,
    "mape/s/knowledge/since?pass=3;stage=1": CLIENTS,
    "mape/s/knowledge/table": {"plan", "execute", "operator"},
    "mape/s/knowledge/status": CLIENTS,
    "mape/s/knowledge/swap": {"operator"},
    "mape/*/knowledge/status": CLIENTS,
    # What reaches beyond a right is not let through to the part of it that is within.
    "mape/s/0/append/*": NOBODY,
    "mape/s/0/append/**": NOBODY,
    "mape/s/knowledge/*": NOBODY,
    "mape/s/knowledge/**": NOBODY,
    "mape/s/knowledge/join/*": NOBODY,
    "mape/s/*/*/plan": NOBODY,
    "mape/**": NOBODY,
    "**": NOBODY,
    # What is not in the list.
    "mape/s/0/append/operator": NOBODY,
    "mape/s/0/append/knowledge": NOBODY,
    "mape/s/knowledge/join/operator": NOBODY,
    "mape/s/knowledge/remember/execute": NOBODY,
    "mape/s/knowledge/other": NOBODY,
    "mape/s/knowledge/status/more": NOBODY,
}


@pytest.mark.parametrize("key", QUERIES)
def test_a_role_is_answered_what_it_may_ask_and_nothing_else(everybody, key):
    said = {role: set(ask(session, key, payload="x")) for role, session in everybody.sessions.items()}
    assert said == {role: {"knowledge"} if role in QUERIES[key] else set() for role in CLIENTS}


@pytest.mark.parametrize("role", STAGES)
def test_only_knowledge_reaches_the_control_of_a_role(everybody, role):
    key = f"mape/s/control/{role}"
    assert {who: ask(session, key) for who, session in everybody.sessions.items()} == {who: [] for who in CLIENTS}
    assert ask(everybody.knowledge, key) == [role]


@pytest.mark.parametrize("key", ["mape/s/control/*", "mape/*/control/*"])
def test_knowledge_alone_may_ask_all_roles_at_once(everybody, key):
    assert set(ask(everybody.knowledge, key)) == STAGES
    assert all(ask(everybody.sessions[role], key) == [] for role in CLIENTS)


# Who may send what.

STREAMS = [f"mape/s/0/{role}" for role in sorted(STAGES)]
BEATS = {f"mape/s/knowledge/beat/{role}": {role} for role in sorted(STAGES)}
PUTS = {
    **dict.fromkeys(STREAMS, NOBODY),
    **BEATS,
    "mape/*/knowledge/beat/plan": {"plan"},
    "mape/s/knowledge/beat/operator": NOBODY,
    "mape/s/knowledge/beat/*": NOBODY,
    "mape/s/*/plan": NOBODY,
    "mape/*/0/plan": NOBODY,
    "mape/s/0/append/plan": NOBODY,
    "mape/s/alive/plan/1": NOBODY,
    "mape/s/control/plan": NOBODY,
    "mape/s/knowledge/status": NOBODY,
    "mape/**": NOBODY,
    "**": NOBODY,
    "else/s/0/plan": NOBODY,
}


@pytest.mark.parametrize("key", PUTS)
def test_a_role_can_put_its_own_heartbeat_and_nothing_else(everybody, key):
    before = len(everybody.heard)
    for role, session in everybody.sessions.items():
        session.put(key, role)
        session.delete(key)
        in_order(session)
    heard = everybody.heard[before:]
    assert all(sample.kind == zenoh.SampleKind.PUT for sample in heard)
    assert {sample.payload.to_string() for sample in heard} == PUTS[key]


def test_declared_publishers_and_queriers_know_whether_they_are_heard(everybody):
    """What is told of others' declarations is enough: Zenoh sends nothing for which it knows of no taker."""
    for role in STAGES:
        session = everybody.sessions[role]
        with (
            session.declare_publisher(f"mape/s/knowledge/beat/{role}") as beat,
            session.declare_querier(STATUS) as querier,
        ):
            eventually(lambda beat=beat: beat.matching_status.matching)
            eventually(lambda querier=querier: querier.matching_status.matching)
            before = len(everybody.heard)
            beat.put(role)
            assert [reply.ok.payload.to_string() for reply in querier.get()] == ["knowledge"]
            assert [sample.payload.to_string() for sample in everybody.heard[before:]] == [role]


def test_a_forged_plan_reaches_nobody_and_knowledges_own_does(everybody):
    got = []
    with everybody.sessions["execute"].declare_subscriber("mape/s/0/plan", direct(got.append), allowed_origin=REMOTE):
        in_order(everybody.sessions["execute"])
        for role in CLIENTS:
            everybody.sessions[role].put("mape/s/0/plan", f"forged by {role}")
            in_order(everybody.sessions[role])
        everybody.knowledge.put("mape/s/0/plan", "true")
        in_order(everybody.sessions["execute"])
    assert [sample.payload.to_string() for sample in got] == ["true"]


@given(st.from_regex(r"[a-z0-9_-]{1,12}", fullmatch=True), st.integers(0, 10**6), st.sampled_from(sorted(STAGES)))
def test_no_right_to_put_touches_a_stream_of_records(system, loop, role):
    stream = zenoh.KeyExpr(f"mape/{system}/{loop}/{role}")
    puts = [
        key
        for rule in security.access_control()["rules"]
        if "ingress" in rule["flows"] and {"put", "delete"} & set(rule["messages"])
        for key in rule["key_exprs"]
    ]
    assert len(puts) == len(STAGES)
    assert not any(zenoh.KeyExpr(key).intersects(stream) for key in puts)


# Who may see what.

SUBSCRIPTIONS = {
    "mape/*/*/execute": {"monitor", "operator"},
    "mape/s/*/monitor": {"analyze", "operator"},
    "mape/s/0/analyze": {"plan", "operator"},
    "mape/*/0/plan": {"execute", "operator"},
    "mape/s/0/*": {"operator"},
    "mape/*/*/*": {"operator"},
    "mape/s/**": NOBODY,
    "mape/**": NOBODY,
    "**": NOBODY,
}


@pytest.mark.parametrize("key", SUBSCRIPTIONS)
def test_a_role_sees_the_stream_that_it_works_on_and_no_other(everybody, key):
    seen = {role: [] for role in CLIENTS}
    with ExitStack() as declared:
        for role, session in everybody.sessions.items():
            handler = direct(lambda sample, role=role: seen[role].append(str(sample.key_expr)))
            declared.enter_context(session.declare_subscriber(key, handler))
        settle(everybody)
        for stream in STREAMS:
            everybody.knowledge.put(stream, "a record")
        settle(everybody)
    matching = [stream for stream in STREAMS if zenoh.KeyExpr(key).includes(stream)]
    assert seen == {role: matching if role in SUBSCRIPTIONS[key] else [] for role in CLIENTS}


# Who may answer for whom.


@pytest.mark.parametrize("key", [STATUS, "mape/s/knowledge/*", "mape/s/0/append/plan", "mape/s/**", "**"])
def test_nobody_can_answer_in_knowledges_stead(everybody, key):
    with ExitStack() as declared:
        for role, session in everybody.sessions.items():
            handler = direct(lambda query, role=role: reply(query, query.key_expr, role))
            declared.enter_context(session.declare_queryable(key, handler, complete=True))
        settle(everybody)
        for asking in ("execute", "plan"):
            assert ask(everybody.sessions[asking], f"mape/s/0/append/{asking}") == ["knowledge"]
            assert ask(everybody.sessions[asking], STATUS) == ["knowledge"]


@pytest.mark.parametrize("key", ["mape/s/control/plan", "mape/s/control/*", "mape/**"])
def test_nobody_can_answer_in_another_roles_stead(everybody, key):
    with ExitStack() as declared:
        for role in sorted(CLIENTS - {"plan", "operator"}):
            handler = direct(lambda query, role=role: reply(query, "mape/s/control/plan", f"{role}, not plan"))
            declared.enter_context(everybody.sessions[role].declare_queryable(key, handler, complete=True))
        settle(everybody)
        assert ask(everybody.knowledge, "mape/s/control/plan") == ["plan"]


# Who is there.


def alive(session):
    return {str(found.ok.key_expr) for found in session.liveliness().get("mape/*/alive/**", timeout=60)}


def test_a_role_is_seen_under_its_own_name_only_and_by_everybody(deployment):
    join_all(deployment)
    names = CLIENTS | {"knowledge"}
    with ExitStack() as declared:
        for session in deployment.sessions.values():
            for name in names:
                declared.enter_context(session.liveliness().declare_token(f"mape/s/alive/{name}/7"))
        settle(deployment)
        expected = {f"mape/s/alive/{role}/7" for role in STAGES} | {"mape/s/alive/knowledge/1"}
        assert alive(deployment.knowledge) == expected
        for session in deployment.sessions.values():
            assert alive(session) >= expected  # and of its own those that nobody else sees
    settle(deployment)
    assert alive(deployment.knowledge) == {"mape/s/alive/knowledge/1"}


def test_coming_and_going_is_seen_by_everybody(deployment):
    join_all(deployment)
    seen = {role: [] for role in CLIENTS}
    with ExitStack() as declared:
        for role, session in deployment.sessions.items():
            handler = direct(lambda sample, role=role: seen[role].append((sample.kind, str(sample.key_expr))))
            watch = session.liveliness().declare_subscriber("mape/s/alive/*/*", handler, history=True)
            declared.enter_context(watch)
        settle(deployment)
        with deployment.sessions["plan"].liveliness().declare_token("mape/s/alive/plan/9"):
            settle(deployment)
        settle(deployment)
    put, gone = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE
    plan, knowledge = "mape/s/alive/plan/9", "mape/s/alive/knowledge/1"
    assert seen == {role: [(put, knowledge), (put, plan), (gone, plan)] for role in CLIENTS}


# Who is nobody.


@pytest.mark.parametrize("common_name", ["stranger", "knowledge", "Plan", "plan ", "*", "plan/execute"])
def test_a_certificate_of_this_authority_for_no_role_gives_no_right(deployment, common_name):
    stranger = deployment.join("", sign(deployment.keys, "stranger", common_name))
    execute = deployment.join("execute")
    got, seen = [], []
    with (
        execute.declare_subscriber("mape/*/*/plan", direct(got.append)),
        stranger.declare_subscriber("mape/**", direct(seen.append), allowed_origin=REMOTE),
        stranger.declare_queryable("mape/s/**", direct(lambda query: reply(query, query.key_expr, "stranger"))),
        stranger.liveliness().declare_token("mape/s/alive/plan/1"),
    ):
        for key in ("mape/s/0/plan", "mape/s/knowledge/beat/plan"):
            stranger.put(key, "x")
        assert ask(stranger, "mape/s/0/append/plan", payload="x") == []
        assert ask(stranger, "mape/*/knowledge/status") == []
        in_order(execute)
        deployment.knowledge.put("mape/s/0/plan", "true")
        in_order(execute)
        assert alive(execute) == {"mape/s/alive/knowledge/1"}
    assert [sample.payload.to_string() for sample in got] == ["true"]
    assert [sample.payload.to_string() for sample in deployment.heard] == ["true"]
    assert seen == []


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_role_gains_nothing_by_joining_as_a_peer_or_router(deployment, mode):
    monitor = deployment.join("monitor", mode=mode)
    execute = deployment.join("execute")
    eventually(lambda: ask(monitor, STATUS) == ["knowledge"])  # routers take a while to find their routes
    got = []
    with execute.declare_subscriber("mape/*/*/plan", direct(got.append)):
        in_order(execute)
        monitor.put("mape/s/0/plan", "forged")
        assert ask(monitor, "mape/s/0/append/plan", payload="forged") == []
        in_order(monitor)
        deployment.knowledge.put("mape/s/0/plan", "true")
        in_order(execute)
    assert [sample.payload.to_string() for sample in got] == ["true"]
    assert [sample.payload.to_string() for sample in deployment.heard] == ["true"]
