"""The version of the program, as in pyproject.toml."""

__version__ = "0.1.0"


def documentation(page: str) -> str:
    """Where a page such as ``running/gpu`` is: its address, if the installed package names its documentation's."""
    from importlib.metadata import PackageNotFoundError, metadata

    try:
        urls = dict(url.split(", ", 1) for url in metadata("su3d-bench").get_all("Project-URL") or ())
    except PackageNotFoundError:
        urls = {}
    address = urls.get("Documentation")
    return f"page {page} of the documentation" if address is None else f"{address.rstrip('/')}/{page}/"
