"""Settings of the site that `make docs` builds with Sphinx, as docs.ros.org is built."""

import re
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

import generate  # noqa: E402 - beside this file
from markdown_docstrings import to_rst  # noqa: E402
from sphinx.ext.autodoc.mock import mock  # noqa: E402

project = 'vn_nav'
author = 'vn_nav maintainers'
copyright = 'vn_nav maintainers, Apache-2.0'
release = version = re.search(r"__version__ = '(.+)'",
                              (generate.ROOT / 'vn_nav' / '__init__.py').read_text()).group(1)
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'sphinx.ext.viewcode',
              'sphinx_copybutton']
exclude_patterns = ['curves/**']
# Two classes of one name: a type in a signature is then not a link.
suppress_warnings = ['ref.python']

myst_heading_anchors = 3  # links to headings work as on the hosting site

# Docstrings are of Google's style, with `code` in single backquotes.
default_role = 'code'
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_custom_sections = [('States', 'params_style')]
autodoc_member_order = 'bysource'
autodoc_default_options = {'members': True}
autodoc_typehints_format = 'short'
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
# Optional parts: their modules are described where they are not installed, too.
autodoc_mock_imports = ['av', 'pyarrow', 'warp']

highlight_language = 'none'  # of a block that names no language
html_theme = 'furo'
html_title = f'vn_nav {release}'
html_static_path = ['static']
html_css_files = ['site.css']
html_copy_source = False
html_show_sphinx = False


def setup(app):
    """Make the generated pages, and have docstrings and links fit the site."""
    generate.write_all()
    # For the whole build: the pages of sources import modules as well, without the mock, and
    # kernels of a real Warp do not take what a mocked one has made.
    app.mocked = mock(autodoc_mock_imports)
    app.mocked.__enter__()
    app.connect('autodoc-process-docstring', lambda *event: to_rst(event[-1]), priority=400)
    app.connect('source-read', _own_links)


def _own_links(app, page, content):
    if '/' not in page:  # the generated ones have theirs
        content[0] = generate.site_links(content[0], generate.ROOT / 'docs', depth=0)
