"""The command line, one verb a file, each with ``main(argv) -> exit code``; here alone learner and simulation meet."""
