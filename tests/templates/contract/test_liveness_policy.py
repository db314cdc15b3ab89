import itertools

from templates.contract.liveness_policy import LivenessPolicy, joined

ASKS = {"off": set(), "passive": {"p"}, "active": {"a"}, "both": {"p", "a"}}


def asked(policy: LivenessPolicy) -> set[str]:
    return {name for name, asks in (("p", policy.passive), ("a", policy.active)) if asks}


def test_what_a_policy_asks_for() -> None:
    assert {str(policy): asked(policy) for policy in LivenessPolicy} == ASKS


def test_joined_policies_ask_for_all_that_each_of_them_asks_for() -> None:
    assert joined([]) is joined([None]) is LivenessPolicy.OFF
    for policies in itertools.product([None, *LivenessPolicy], repeat=3):
        expected = set().union(*(ASKS[str(policy)] for policy in policies if policy is not None))
        assert asked(joined(policies)) == expected
