"""A pass without the loop: five processes hand on 300 bytes, over bare Zenoh or over Redis pub/sub.

    python hops.py zenoh|redis ADDRESS PASSES LOOPS    prints {"median_us": ..., "passes_per_s": ...}

The hops and acknowledgements are those of `mapek up`: each of four processes sends to a fifth, which publishes what it
got, from which the next one goes on, and acknowledges. Nothing is parsed, logged or computed.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from queue import Empty, SimpleQueue

PAYLOAD = b"x" * 300
PATIENCE = 10.0
LOST = 3  # exit code: neither transport alone promises delivery
BEFORE = {"execute": "plan", "monitor": "execute", "analyze": "monitor", "plan": "analyze"}


class OverZenoh:
    """Hops as queries to a router, which publishes, then replies."""

    def __init__(self, address, mode):
        import zenoh

        self.zenoh = zenoh
        self.ordered = {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.DATA}
        off = {"enabled": False}
        ends = {"endpoints": [address], "timeout_ms": 10_000}
        config = {
            "mode": mode,
            ("listen" if mode == "router" else "connect"): ends if mode == "client" else {"endpoints": [address]},
            "scouting": {"delay": 0, "multicast": off, "gossip": off},
            "transport": {"shared_memory": off},
        }
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.came = SimpleQueue()

    def direct(self, take):
        return self.zenoh.handlers.Callback(take, indirect=False)

    def relay(self, loops):
        self.session.declare_queryable("mape/x/*/append/*", self.direct(self.came.put), complete=True)
        self.token = self.session.liveliness().declare_token("mape/alive/knowledge")
        while True:
            with self.came.get() as query:
                key = str(query.key_expr)
                # By no declared publisher: for a moment that would know of no taker, and send nothing.
                self.session.put(key.replace("append/", ""), query.payload.to_bytes(), **self.ordered)
                query.reply(key, b"ok")

    def join(self, role):
        self.session.declare_subscriber(f"mape/x/*/{BEFORE[role]}", self.direct(self.came.put))
        self.acknowledged = self.direct(SimpleQueue().put)
        while not list(self.session.get("mape/x/0/append/nobody", payload=PAYLOAD, timeout=1)):
            pass  # for a moment after all have declared themselves, a query may still find nobody
        self.token = self.session.liveliness().declare_token(f"mape/alive/{role}")

    def everybody_is_there(self):
        # As a set: one's own token may be told twice.
        here = {str(reply.ok.key_expr) for reply in self.session.liveliness().get("mape/alive/*") if reply.ok}
        return len(here) == len(BEFORE) + 1

    def send(self, loop, role):
        self.session.get(f"mape/x/{loop}/append/{role}", self.acknowledged, payload=PAYLOAD, timeout=5, **self.ordered)

    def receive(self):
        try:
            return int(str(self.came.get(timeout=PATIENCE).key_expr).split("/")[2])
        except Empty:
            sys.exit(LOST)


class OverRedis:
    """The same hops as publications: to the fifth process, from it to the next one, and back to who sent."""

    def __init__(self, address, mode):
        import redis

        self.redis = redis.Redis.from_url(address)

    def relay(self, loops):
        taken = self.redis.pubsub(ignore_subscribe_messages=True)
        taken.psubscribe("append:*")
        for message in taken.listen():
            _, loop, role = message["channel"].split(b":")
            self.redis.publish(b"stream:%s:%s" % (loop, role), message["data"])
            self.redis.publish(b"ack:%s" % role, b"ok")

    def join(self, role):
        self.came = self.redis.pubsub(ignore_subscribe_messages=True)
        self.came.psubscribe(f"stream:*:{BEFORE[role]}")
        self.came.subscribe(f"ack:{role}")
        self.came.get_message(timeout=1)
        self.redis.sadd("here", role)

    def everybody_is_there(self):
        return self.redis.scard("here") == len(BEFORE) and self.redis.pubsub_numpat() == len(BEFORE) + 1

    def send(self, loop, role):
        self.redis.publish(f"append:{loop}:{role}", PAYLOAD)

    def receive(self):
        deadline = time.monotonic() + PATIENCE
        while True:
            message = self.came.get_message(timeout=PATIENCE)
            if message is None:  # a confirmation that is ignored comes as nothing, too
                if time.monotonic() > deadline:
                    sys.exit(LOST)
                continue
            if message["channel"].startswith(b"stream"):
                return int(message["channel"].split(b":")[1])


TRANSPORTS = {"zenoh": OverZenoh, "redis": OverRedis}


def hand_on(over, role):
    over.join(role)
    while True:
        over.send(over.receive(), role)


def drive(over, passes, loops):
    over.join("execute")
    while not over.everybody_is_there():
        time.sleep(0.01)  # before any clock runs, for a bare transport that tells nobody who has come
    times, left = [], [passes] * loops
    for loop in range(loops):
        over.send(loop, "execute")
    last = time.perf_counter()
    while any(left):
        loop = over.receive()
        now = time.perf_counter()
        times.append(now - last)
        last = now
        left[loop] -= 1
        if left[loop]:
            over.send(loop, "execute")
    return figures(times)


def figures(times):
    """Return median and rate, without the first tenth, in which all warms up."""
    times = times[len(times) // 10 :]
    return {"median_us": statistics.median(times) * 1e6, "passes_per_s": len(times) / sum(times)}


def main():
    sys.setswitchinterval(0.0005)
    transport, address, passes, loops, *role = sys.argv[1:]
    if role:
        over = TRANSPORTS[transport](address, "router" if role[0] == "knowledge" else "client")
        if role[0] == "knowledge":
            over.relay(int(loops))
        hand_on(over, role[0])
    others = [
        subprocess.Popen([sys.executable, __file__, *sys.argv[1:], name], start_new_session=True)
        for name in ("knowledge", "monitor", "analyze", "plan")
    ]
    try:
        found = drive(TRANSPORTS[transport](address, "client"), int(passes), int(loops))
    finally:
        for other in others:
            other.kill()
            other.wait()
    print(json.dumps(found), flush=True)
    os._exit(0)  # Zenoh's callbacks would keep the process


if __name__ == "__main__":
    main()
