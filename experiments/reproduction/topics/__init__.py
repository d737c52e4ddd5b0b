"""What the report tells of: a module for each topic, with its claims, judgements and section."""
