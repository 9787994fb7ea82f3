"""Programs of EPypes 0.1 are run by the tests, and are no tests themselves."""

collect_ignore = ["programs"]
