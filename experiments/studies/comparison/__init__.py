"""The comparison of methods: settings, methods, tables, pictures."""
