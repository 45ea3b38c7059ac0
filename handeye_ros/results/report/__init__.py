"""One HTML file that shows an answer to a person: page.write makes it."""
