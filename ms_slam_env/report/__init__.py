"""Results: their statistics, tables, charts and records, and the page that shows them."""
