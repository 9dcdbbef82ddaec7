"""Review of a cleaned take: decisions on its changes and corrections by its user, in a file and in the browser."""
