"""The pages of a checkout: their tables and model cards, and the site."""
