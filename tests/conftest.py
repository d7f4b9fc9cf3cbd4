"""Settings for all tests."""

import hypothesis

# The same examples on every run: a test that fails by chance on another's commit helps nobody.
hypothesis.settings.register_profile("refine", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.register_profile(
    "quick", hypothesis.settings.get_profile("refine"), max_examples=8
)
hypothesis.settings.load_profile("refine")
