"""Formulating problems: tasks as memories, rows and objectives of your own, all criteria."""
