"""Entry point: finds the command, maps errors to exit statuses."""


def main() -> None:
    """Run the command line."""
