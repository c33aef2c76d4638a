"""`Solid`: a boundary that passed every check; checks, repair, closing, base, hollowing."""
