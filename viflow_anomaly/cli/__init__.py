"""The ``viflow-anomaly`` command: the only place that prints and exits. No command loads torch before it runs."""
