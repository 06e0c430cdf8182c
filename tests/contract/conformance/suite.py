"""The rules as a test class: a subclass says on which bus."""

import pytest

from tests.contract.conformance import nmt_rules, pdo_rules, sdo_rules, timing_rules
from tests.contract.conformance.rig import RESET_NODE, Rig
from tests.contract.conformance.rule import Rule

RULES = (*nmt_rules.RULES, *sdo_rules.RULES, *pdo_rules.RULES, *timing_rules.RULES)


class ConformanceSuite:
    """Each rule on a device that was just reset; a fixture ``rig`` is given by the subclass."""

    @pytest.mark.parametrize("rule", RULES, ids=[rule.name for rule in RULES])
    def test_rule(self, rule: Rule, rig: Rig) -> None:
        rig.nmt(RESET_NODE)
        rule.check(rig)
