"""The pages: every one in the navigation, every relative link leads somewhere, lines are short."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / 'docs'
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'bags' / 'README.md',
         *sorted(DOCS.glob('*.md')), *sorted(DOCS.glob('simulators/*.md'))]
CARDS = sorted(ROOT.glob('models/*/README.md'))  # written by a command
WIDTH = 100
# A file that a page names in `code`, and those that are on their way.
NAMED_FILE = re.compile(r'`((?:bench|config|docs|examples|launch|models|test|vn_msgs_py|vn_nav|'
                        r'vn_sim_bridge)/[\w./-]+)`')
COMING = set()


def module(name):
    """A module out of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f'{name}.py')
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


generate, markdown_docstrings = module('generate'), module('markdown_docstrings')


def prose(path):
    """A page's text without its blocks of code."""
    return re.sub(r'^```.*?^```', '', path.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(path):
    """Anchors of a page's headings, as the hosting site and the built one make them."""
    headings = re.findall(r'^#+ (.+)$', prose(path), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def navigation():
    """Page names in the tables of contents of docs/index.md."""
    trees = re.findall(r'^```{toctree}\n(.*?)^```', (DOCS / 'index.md').read_text(),
                       re.MULTILINE | re.DOTALL)
    lines = [line for tree in trees for line in tree.splitlines()
             if line and not line.startswith(':')]
    names = [re.sub(r'.*<(.+)>', r'\1', line) for line in lines]
    return [found for name in names for found in (
        sorted(str(path.relative_to(DOCS).with_suffix('')) for path in DOCS.glob(f'{name}.md'))
        if '*' in name else [name])]


def test_every_page_is_in_the_navigation():
    written = {path.stem for path in DOCS.glob('*.md')} - {'index'} | {
        f'simulators/{path.stem}' for path in DOCS.glob('simulators/*.md')}
    made = {f'generated/{name}' for name in (*generate.pages(), *generate.PACKAGES)}
    listed = navigation()
    assert set(listed) == written | made
    assert len(listed) == len(set(listed))


@pytest.mark.parametrize('path', [*PAGES, *CARDS],
                         ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_somewhere(path):
    for _, _, target in generate.LINK.findall(prose(path)):
        file, _, anchor = target.partition('#')
        if ':' in target:
            continue
        if file.startswith('generated/'):
            assert file.removeprefix('generated/').removesuffix('.md') in generate.pages(), target
            continue
        linked = (path.parent / file).resolve() if file else path
        assert linked.exists(), f'{path.name}: {target}'
        assert linked.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(linked), f'{path.name}: {target}'


@pytest.mark.parametrize('path', PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_file_that_a_page_names_is_there(path):
    named = {name for name in NAMED_FILE.findall(prose(path)) if 'NAME' not in name} - COMING
    missing = [name for name in named if not (ROOT / name).exists()]
    assert not missing, f'{path.name}: {missing}'


@pytest.mark.parametrize('path', [*PAGES, ROOT / 'CHANGELOG.rst'],
                         ids=lambda path: str(path.relative_to(ROOT)))
def test_lines_are_short(path):
    long = [f'{path.name}:{number}: {len(line)} characters'
            for number, line in enumerate(path.read_text().splitlines(), 1)
            if len(line) > WIDTH and not line.startswith('|')]  # a table's row is one line
    assert not long, long


def test_every_page_of_readme_finds_its_sections():
    sections = generate.readme_sections()
    for title, names in generate.README_PAGES.values():
        assert title and all(sections[name].strip() for name in names)


def test_links_of_the_repository_become_links_of_the_site():
    text = ('[a](docs/bags.md#teach) ![b](docs/images/demo.png) [c](models/house/README.md) '
            '[d](config/robots) [e](https://example.org) [f](#topics)')
    assert generate.site_links(text, ROOT) == (
        '[a](../bags.md#teach) ![b](../images/demo.png) [c](../generated/model_house.md) '
        'd [e](https://example.org) [f](#topics)')
    assert generate.site_links('[a](../README.md), [b](method.md)', DOCS, depth=0) == (
        '[a](index.md), [b](method.md)')


def test_tables_of_docstrings_become_lists():
    lines = ['Where:', '', '| a | b |', '|---|---|', '| `x|y` | 1 |', '', 'where |grad T| = 1']
    markdown_docstrings.to_rst(lines[:0])
    lines[4] = '| `x` | `y`s |'
    markdown_docstrings.to_rst(lines)
    assert lines == [
        'Where:', '', '', '.. list-table::', '   :header-rows: 1', '', '   * - a', '     - b',
        '   * - `x`', '     - `y`\\ s', '', '', r'where \|grad T\| = 1']


def test_several_results_become_a_list():
    lines = ['Draw.', '', 'Returns:', '    image: [V,3] uint8.', '    first, second: [K], views;',
             '        the second is the goal.', '']
    markdown_docstrings.to_rst(lines)
    assert lines[2:6] == [
        ':returns:', '    - image: [V,3] uint8.', '    - first, second: [K], views;',
        '          the second is the goal.']
    one = ['Returns:', '    [N] float32.', '']
    markdown_docstrings.to_rst(one)
    assert one == ['Returns:', '    [N] float32.', '']


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    if importlib.util.find_spec('sphinx') is None:
        pytest.skip('expected: `make docs` brings Sphinx along, and has not run here')
    built = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-b', 'dummy', '-W', '--keep-going', '-q',
         '-d', str(tmp_path / 'cache'), str(DOCS), str(tmp_path / 'out')],
        capture_output=True, text=True, timeout=110)
    assert built.returncode == 0, built.stderr
