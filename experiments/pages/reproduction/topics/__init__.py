"""The topics of the page, each with its claims and its section."""
