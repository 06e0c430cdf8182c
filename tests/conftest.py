"""What every test gets: suites and helpers tell, as tests do, with what their assertions failed."""

import pytest

pytest.register_assert_rewrite("tests.contract", "tests.scenario", "tests.truth")
