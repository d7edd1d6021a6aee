"""The pages of the site that are made from other files: README, CONTRIBUTING, docstrings.

They are written into docs/generated, which git ignores. README stays the one home of its text.
"""

import ast
import re
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERATED = ROOT / 'docs' / 'generated'
PACKAGES = ('vn_nav', 'vn_sim_bridge', 'vn_msgs_py')

# Page: its title, and the sections of README that it shows.
README_PAGES = {
    'start': ('First drive', ('Two commands', 'What it does today', 'Honest limits')),
    'robot': ('On a robot', ('On an installed ROS 2 Jazzy', 'Topics', 'Services', 'Parameters')),
    'training': ('Training', ('Train your own',)),
    'simulator': ('The simulator', ('The simulator',)),
}
WHOLE_FILES = {  # source: its page
    'CONTRIBUTING.md': 'contributing',
    'models/house/README.md': 'model_house',
    'models/anywhere/README.md': 'model_anywhere',
    'models/search/README.md': 'model_search',
}
LINK = re.compile(r'(!?)\[([^\]]*)\]\(([^)\s]+)\)')


def pages():
    """Page names of docs/generated apart from the API reference."""
    return [*README_PAGES, *WHOLE_FILES.values(), 'changelog']


def write_all():
    """Write every generated page anew."""
    shutil.rmtree(GENERATED, ignore_errors=True)
    GENERATED.mkdir()
    sections = readme_sections()
    for page, (title, names) in README_PAGES.items():
        whole = ''.join(f'## {name}\n{sections[name]}' for name in names)
        if len(names) == 1:  # its heading is the page's
            whole = sections[names[0]].replace('\n### ', '\n## ')
        _write(f'{page}.md', f'# {title}\n\n{site_links(whole, ROOT)}')
    for source, page in WHOLE_FILES.items():
        path = ROOT / source
        _write(f'{page}.md', site_links(path.read_text(), path.parent))
    _write('changelog.rst', (ROOT / 'CHANGELOG.rst').read_text())
    for package in PACKAGES:
        _package_page(ROOT / package)


def readme_sections():
    """README's sections of the second level: heading to text."""
    parts = re.split(r'^## (.+)\n', (ROOT / 'README.md').read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def site_links(text, folder, depth=1):
    """The links of a Markdown text from `folder`, for a page `depth` folders below docs/."""
    up = '../' * depth

    def to_site(match):
        image, label, target = match.groups()
        file, hash_, anchor = target.partition('#')
        if not file or ':' in target:
            return match.group()
        path = (folder / file).resolve().relative_to(ROOT).as_posix()
        if path in WHOLE_FILES:
            file = f'{up}generated/{WHOLE_FILES[path]}.md'
        elif path == 'README.md':
            file = f'{up}index.md'
        elif path.startswith('docs/'):
            file = up + path.removeprefix('docs/')
        else:  # of the repository alone
            return label
        return f'{image}[{label}]({file}{hash_}{anchor})'
    return LINK.sub(to_site, text)


def _package_page(folder):
    children = [path for path in sorted(folder.iterdir()) if (path / '__init__.py').is_file()]
    modules = [path for path in sorted(folder.glob('*.py')) if path.name != '__init__.py']
    for child in children:
        _package_page(child)
    for module in modules:
        name = _dotted(module)
        _write(f'{name}.rst', f'{_title(name)}.. automodule:: {name}\n')
    name = _dotted(folder)
    text = f'{_title(name)}.. automodule:: {name}\n\n'
    if children or modules:
        text += '.. list-table::\n   :widths: 40 60\n\n' + ''.join(
            f'   * - :doc:`{_dotted(path)} <{_dotted(path)}>`\n     - {_summary(path)}\n'
            for path in [*children, *modules])
        text += '\n.. toctree::\n   :hidden:\n\n' + ''.join(
            f'   {path.stem} <{_dotted(path)}>\n' for path in [*children, *modules])
    _write(f'{name}.rst', text)


def _dotted(path):
    return '.'.join(path.relative_to(ROOT).with_suffix('').parts)


def _title(name):
    return f'{name}\n{"=" * len(name)}\n\n'


def _summary(path):
    source = path / '__init__.py' if path.is_dir() else path
    return (ast.get_docstring(ast.parse(source.read_text())) or '').partition('\n')[0]


def _write(name, text):
    (GENERATED / name).write_text(text)
