"""What streams judged a moment ago, for who looks on: recent pairs, their pictures, a live stream of events."""
