"""Known answers: closed forms that tests, charts and README quote."""
