"""Reports of applications: HTML pages, drawings of surfaces, folders of results."""
