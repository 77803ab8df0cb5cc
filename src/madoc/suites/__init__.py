"""Many runs as one piece of work: a suite file planned into cells, done by worker processes, and reported together."""
