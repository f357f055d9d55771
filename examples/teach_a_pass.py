"""One pass of the loop, by hand: who says what to whom."""

from adapters.cli.sentences import sentence
from adapters.systems import make_system
from knowledge import Knowledge, Log
from mape import load
from mape.loop import build_analyze, build_execute, build_monitor, build_plan, layout_of

config = load("gridworld_goals")
system = make_system(config.system)
knowledge = Knowledge(Log(layout_of(config, system)))
said = []


def send(record):
    said.append(record)
    print(knowledge.log.append(record).value, sentence(record))


monitor, analyze = build_monitor(config, send), build_analyze(config, send)
plan, execute = build_plan(config, knowledge, send), build_execute(config, system, knowledge, send)

execute.adopt(plan.start(loop=0))  # plan 0 starts a run
execute.drive()  # episode 1; sends the Observation
monitor.on_observation(said[-1])  # sends the Symptom
analyze.on_symptom(said[-1])  # sends the ChangeRequest
plan.on_request(said[-1])  # sends plan 1 ...
execute.adopt(said[-1])  # ... which is in force from episode 2 on
