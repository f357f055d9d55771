"""Parts with one fault each, made of those that keep every clause of their contract."""

from types import SimpleNamespace

from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
from mape.plan.exponential import Exponential, ExponentialConfig
from mape.plan.morphin import Morphin, MorphinConfig

MEMBERS = "has the members of the port"


def faults(findings):
    return {finding.check: finding.detail for finding in findings if finding.verdict == "failed"}


def variant(base, *arguments, **members):
    """A maker of `base` with some members replaced."""
    made = type(base.__name__, (base,), members)
    return lambda: made(*arguments)


def without(base, *arguments, member):
    """A maker of `base` without a member."""

    def make():
        part = base(*arguments)
        names = [n for n in dir(part) if not n.startswith("_") and n != member]
        return SimpleNamespace(**{n: getattr(part, n) for n in names})

    return make


def hinkley(**members):
    return variant(PageHinkley, PageHinkleyConfig(), **members)


def scheduled(**members):
    return variant(Exponential, ExponentialConfig(), **members)


def planning(**members):
    made = type("Morphin", (Morphin,), members)
    config = MorphinConfig(alpha=0.1, alpha_max=0.9, k=5.0, enable_on_drift=(3, 4))
    return lambda: made(config, Exponential(ExponentialConfig()))


def planned(**fields):
    def plan(self, request, knowledge):
        made = Morphin.plan(self, request, knowledge)
        return made._replace(**{n: f(request, knowledge) for n, f in fields.items()})

    return planning(plan=plan)
