"""The page in the browser: a finished model to be relit by hand, in one self-contained HTML file."""
