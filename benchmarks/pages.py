"""What benchmarks write into the pages."""

from pathlib import Path

from polarmpm import study


def quote(page: Path, name: str, said: str) -> None:
    """Put it between a page's marks, `<!-- name -->` and the next `<!-- end -->`."""
    before, rest = page.read_text().split(f"<!-- {name} -->", 1)
    after = rest.split("<!-- end -->", 1)[1]
    study.write_text(page, f"{before}<!-- {name} -->{said}<!-- end -->{after}")
