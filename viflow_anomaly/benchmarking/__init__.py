"""What this package costs on the machine it runs on, measured beside what else could be run there."""
