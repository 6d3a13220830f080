"""`make reference`: writes the pages."""

from flotilla.common import paths
from flotilla.reference.pages import FOLDER, PAGES, RUNTIME_PAGES

for name, page in PAGES.items():
    (FOLDER / name).write_text(page(), encoding="utf-8")
for path, runtime_page in RUNTIME_PAGES.items():
    path.write_text(runtime_page(paths.BUILD / "runtime"), encoding="utf-8")
