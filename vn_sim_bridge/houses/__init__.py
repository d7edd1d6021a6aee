"""Sources of houses: each turns a description into a Scene with goals and distances."""
