"""Events: when something begins to move by itself, that it goes on, and when it ends; and who is told of it."""
