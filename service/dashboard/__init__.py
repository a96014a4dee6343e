"""The dashboard: plain files that a browser loads, and the sample that it can play."""
