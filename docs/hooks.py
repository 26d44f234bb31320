"""What mkdocs does besides: README is the front page, and what pages link to outside docs/ is in the site, too."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
OUTSIDE = "repository"  # the folder of the site with files that lie outside docs/
LOG = get_plugin_logger(__name__)
LINK = re.compile(r'(\]\(|src=")([^)"#\s:]+)(#[^)"]*)?([)"])')


def targets(path: Path) -> list[Path]:
    """Return the files and folders of the repository that a page's links lead to."""
    found = {(path.parent / match[2]).resolve(): None for match in LINK.finditer(path.read_text(encoding="utf-8"))}
    return [target for target in found if target.exists() and target.is_relative_to(ROOT)]


def site_path(target: Path) -> str:
    """Return where a file of the repository is in the site's sources."""
    if target == ROOT / "README.md":
        return "index.md"
    if target.is_relative_to(ROOT / "docs"):
        return target.relative_to(ROOT / "docs").as_posix()
    return f"{OUTSIDE}/{target.relative_to(ROOT).as_posix()}"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add README and, from page to page, what is linked to outside docs/."""
    todo = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    seen = set(todo)
    while todo:
        path = todo.pop()
        if path == ROOT / "README.md" or not path.is_relative_to(ROOT / "docs"):
            uri, level = site_path(path), InclusionLevel.INCLUDED  # whatever exclude_docs says of docs/
            files.append(File.generated(config, uri, abs_src_path=str(path), inclusion=level))
        new = [each for each in targets(path) if each.is_file() and each not in seen] if path.suffix == ".md" else []
        seen.update(new)
        todo += new
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links out of docs/ into links within the site; one to a folder becomes its text."""
    source = Path(page.file.abs_src_path or "")
    markdown = re.sub(r"\[([^\]]+)\]\(([^):#\s]+)\)", lambda link: _text_of_folder(link, source.parent), markdown)

    def within(match: re.Match[str]) -> str:
        target = (source.parent / match[2]).resolve()
        if not target.is_relative_to(ROOT) or not target.exists():
            return match[0]
        found = files.get_file_from_path(site_path(target))
        if found is None or found.inclusion.is_excluded():  # mkdocs would only mention it, and --strict not fail
            LOG.warning(f"{source.relative_to(ROOT)} links to {match[2]}, which the site does not have")
        up = "../" * page.file.src_uri.count("/") if match[1] == "](" else "../" * page.url.count("/")
        return f"{match[1]}{up}{site_path(target)}{match[3] or ''}{match[4]}"

    return LINK.sub(within, markdown)


def _text_of_folder(link: re.Match[str], folder: Path) -> str:
    return link[1] if (folder / link[2]).is_dir() else link[0]
