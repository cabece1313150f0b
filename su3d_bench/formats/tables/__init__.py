"""Result tables, and tables that annotators fill in: CSV rows and worksheets."""
