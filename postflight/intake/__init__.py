"""An analyst's own data: forms to start from, and what each delivered file and column is."""
