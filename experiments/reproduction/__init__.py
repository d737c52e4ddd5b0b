"""The paper measured again: studies, claims and their verdicts, and the report of them."""
