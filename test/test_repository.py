"""What surrounds the sources: workflow, hooks, issue forms, citation, Python versions."""

import ast
import re
import warnings
from pathlib import Path

import pytest
import yaml
from catkin_pkg.changelog import get_changelog_from_path

import vn_nav

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ('bags', 'bench', 'docs', 'examples', 'launch', 'test', 'vn_msgs_py', 'vn_nav',
           'vn_sim_bridge')
SOURCES = [ROOT / 'setup.py', *(path for folder in FOLDERS
                                for path in sorted((ROOT / folder).rglob('*.py')))]
# Of the standard library, gone in Python 3.12 or 3.13.
GONE = {
    'asynchat', 'asyncore', 'distutils', 'imp', 'smtpd',
    'aifc', 'audioop', 'cgi', 'cgitb', 'chunk', 'crypt', 'imghdr', 'lib2to3', 'mailcap', 'msilib',
    'nis', 'nntplib', 'ossaudiodev', 'pipes', 'sndhdr', 'spwd', 'sunau', 'telnetlib', 'uu',
    'xdrlib',
}


def read(name):
    return yaml.safe_load((ROOT / name).read_text())


def targets():
    """Goals of the Makefile."""
    phony = re.search(r'^\.PHONY: (.+)$', (ROOT / 'Makefile').read_text(), re.MULTILINE)
    return set(phony.group(1).split())


@pytest.mark.slow
def test_every_source_is_good_for_the_python_versions_to_come():
    """Compiled by the Python that runs, warnings as errors; no module that later ones lack.

    `make lint` has ruff read them by the grammars of 3.11 and 3.12.
    """
    assert len(SOURCES) > 200
    for path in SOURCES:
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            tree = ast.parse(path.read_text(), str(path))
            compile(tree, str(path), 'exec')
        for node in ast.walk(tree):
            names = ([alias.name for alias in node.names] if isinstance(node, ast.Import) else
                     [node.module] if isinstance(node, ast.ImportFrom) and node.module
                     and not node.level else [])
            gone = {name.partition('.')[0] for name in names} & GONE
            assert not gone, f'{path}:{node.lineno}: {gone}'


def test_the_workflow_runs_what_make_has_on_the_pythons_that_are_supported():
    workflow = read('.github/workflows/test.yml')
    assert set(workflow) >= {'name', 'permissions', 'jobs', True}  # `on` is YAML 1.1's true
    commands = []
    for job in workflow['jobs'].values():
        assert job['timeout-minutes'] <= 60
        for step in job['steps']:
            assert len({'uses', 'run'} & set(step)) == 1
            commands += [step['run']] if 'run' in step else []
    assert {'make lint', 'make test', 'make docs'} == set(commands)
    assert all(command.split()[1] in targets() for command in commands)
    pythons = workflow['jobs']['test']['strategy']['matrix']['python']
    assert pythons == ['3.11', '3.12', '3.13']  # texts: 3.10 as a number would be 3.1
    supported = re.search(r"python_requires='>=(3\.\d+)'", (ROOT / 'setup.py').read_text())
    assert pythons[0] == supported.group(1)


def test_ci_runs_no_test_twice():
    commands = [line for line in (ROOT / '.ci' / 'run').read_text().splitlines()
                if line.startswith('make')]
    assert commands == ['make lint', 'make test-all']  # `make test` is part of `make test-all`


def test_the_hooks_run_what_is_there():
    hooks = [hook for repo in read('.pre-commit-config.yaml')['repos'] for hook in repo['hooks']]
    assert {hook['id'] for hook in hooks} == {'ruff', 'lint'}
    for hook in hooks:
        assert hook['language'] == 'system' and hook['stages']
        program, *arguments = hook['entry'].split()
        if program == 'make':
            assert arguments[0] in targets()
        else:
            assert program == '.venv/bin/python' and arguments[:2] == ['-m', 'ruff']


@pytest.mark.parametrize('name', ['bug', 'robot', 'feature'])
def test_issue_forms(name):
    form = read(f'.github/ISSUE_TEMPLATE/{name}.yml')
    assert form['name'] and form['description'] and form['labels']
    names = [part['id'] for part in form['body']]
    assert len(names) == len(set(names)) > 1
    for part in form['body']:
        assert part['type'] in ('textarea', 'input') and part['attributes']['label']
    assert any(part.get('validations', {}).get('required') for part in form['body'])


def test_the_citation_names_software_and_thesis():
    citation = read('CITATION.cff')
    assert citation['cff-version'] == '1.2.0' and citation['type'] == 'software'
    assert str(citation['version']) == vn_nav.__version__
    assert citation['title'] and citation['message'] and citation['authors']
    thesis, = citation['references']
    assert thesis['type'] == 'thesis' and thesis['year'] == 2019
    assert thesis['title'] == 'Visual Navigation using Deep Reinforcement Learning'


def test_the_changelog_has_this_version():
    changelog = get_changelog_from_path(str(ROOT))  # as the tools of ROS read it
    versions = [version for version, *_ in changelog.foreach_version()]
    assert versions[-1] == vn_nav.__version__
    assert all(content for _, _, content in changelog.foreach_version())
