"""The paper as published: its rules of a valid plan, the conditions of its loss, and its proposals of motions."""
