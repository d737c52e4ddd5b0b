"""The claims of the report, by what they are about."""
